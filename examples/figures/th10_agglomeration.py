"""Lines at growing distance, after TH10 fig. 7.4: a rippled mesh with noise on its right half.

python examples/figures/th10_agglomeration.py [-o agglomeration.png] [--size 300]

Above our ridges and valleys: they merge cleanly, and the noise is gone from afar. Below, where the surface's own
curvature (vertex by vertex, as in object space) exceeds a threshold: noise is always there, and piles up.
"""

import argparse

import numpy as np

import shapeenh as se


def rippled(n: int = 161, noise: float = 0.004):
    """A sheet of 2 x 2 with waves around its centre, and noise where x > 0."""
    y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j]
    r = np.hypot(x, y)
    z = 0.05 * np.cos(22 * r) / (1 + 0.5 * r)
    z += np.where(x > 0, noise, 0) * np.random.default_rng(5).normal(size=z.shape)
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate([np.stack(corners, -1).reshape(-1, 3) for corners in ((a, b, d), (a, d, c))])
    return se.make_mesh(np.float32(np.stack([x, y, z], -1).reshape(-1, 3)), np.int32(faces))


def view(mesh, distance: float, size: int):
    """(our ink, thresholded curvature of the surface), [size, size]."""
    camera = se.orthographic_camera((0, -1.2, 2.0), (0, 0, 0), height=1.9 * distance, aspect=1.0)
    gbuffer = se.render_gbuffer(mesh, camera, height=size, width=size)
    descriptor = se.describe(gbuffer, sigma=1.5)
    clear = 1.0
    for kind in ("valley", "ridge"):
        brush = se.style_brush("ink", kind, height=600)
        field = se.line_field(kind, gbuffer, descriptor)
        profile = se.fit_profile(field, least=float(brush.low))
        strokes = se.draw_lines(profile, field, brush, gbuffer=gbuffer, descriptor=descriptor)
        clear = clear * (1 - np.asarray(strokes[..., 3]))
    visible = se.rasterize(mesh, camera, height=size, width=size)
    tensor = se.interpolate(se.vertex_curvature(mesh), mesh, camera, visible)
    concave, convex = se.principal_curvatures(se.describe_object(gbuffer, tensor, camera).hessian)
    return 1 - clear, np.maximum(concave, -convex) > 0.08 * distance


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", default="agglomeration.png")
    parser.add_argument("--size", type=int, default=300)
    arguments = parser.parse_args()
    mesh = rippled()
    columns = [np.concatenate(view(mesh, distance, arguments.size)) for distance in (1, 2, 4)]
    se.save_image(arguments.output, np.float32(1 - np.concatenate(columns, axis=1)))


if __name__ == "__main__":
    main()
