"""The descriptor pictures of Vergne's thesis (TH10 ch. 4) on any mesh: figs 4.3, 4.5, 4.7, 4.9, 4.10, and the legend.

python examples/figures/th10_descriptors.py [MESH] [-o FOLDER] [--height 360]

Writes FOLDER/fig_4_3.png and so on. Without a mesh: the carved knot.
"""

import argparse
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import shapeenh as se

DIRECTION = (0.34, 0.26, 0.9)


def view(mesh, height, *, zoom=1.0):
    """A G-buffer and the object-centred descriptor of the same view; `zoom` < 1: from farther away."""
    camera = se.frame_mesh(mesh, direction=DIRECTION, aspect=1.0, fov_degrees=30.0)
    projection = np.array(camera.projection)
    projection[:2] *= zoom
    camera = se.Camera(view=camera.view, projection=jnp.asarray(projection))
    size = {"height": height, "width": height}
    gbuffer = se.render_gbuffer(mesh, camera, **size)
    tensor = se.interpolate(se.vertex_curvature(mesh), mesh, camera, se.rasterize(mesh, camera, **size))
    return gbuffer, se.describe_object(gbuffer, tensor, camera)


def colors(descriptor, gbuffer, scale):
    return np.asarray(se.curvature_colors(descriptor, gbuffer.mask, scale=scale))


def shaded(gbuffer):
    """The surface itself, grey, lit from the upper left."""
    light = np.array([-0.4, 0.5, 0.77])
    lit = np.clip(np.asarray(gbuffer.normal) @ light, 0, 1) ** 0.6
    return np.where(np.asarray(gbuffer.mask), 0.1 + 0.85 * lit, 1)[..., None].repeat(3, -1)


def around(gbuffer, row, column):
    """Distance from a place, in image heights."""
    height = gbuffer.mask.shape[0]
    rows, columns = (np.mgrid[:height, :height] + 0.5) / height
    return np.hypot(rows - row, columns - column)


def figure_4_3(mesh, height):
    """Apparent relief: the object's convexities, what the image shows of them, and both; the legend."""
    g, base = view(mesh, height)
    relief = se.describe_relief(g, sigma=1.0, beta=-1.0, base=base)
    strength = np.abs(np.asarray(se.mean_curvature(relief.hessian)))
    sign = np.sign(np.asarray(se.mean_curvature(base.hessian)))[..., None]
    signs = np.where(np.asarray(g.mask)[..., None], np.where(sign < 0, (0.2, 0.6, 0.95), (1.0, 0.62, 0.15)), 1)
    grey = np.where(np.asarray(g.mask), 1 - np.clip(2 * strength, 0, 1), 1)[..., None].repeat(3, -1)
    return [shaded(g), signs, grey, colors(relief, g, 0.4), se.curvature_legend(height, scale=0.4)]


def figure_4_5(mesh, height):
    """Relief at a fine and a coarse scale, and fine around one place alone."""
    g, base = view(mesh, height)
    near = around(g, 0.4, 0.4)
    focus = jnp.asarray(np.clip(0.7 + 40 * (near - 0.12), 0.7, 6.0), g.normal.dtype)
    scales = (0.7, 6.0, focus)
    reliefs = [se.describe_relief(g, sigma=s, beta=-1.0, base=base, scales=6) for s in scales]
    return [shaded(g), *(colors(relief, g, 0.4) for relief in reliefs)]


def figure_4_7(mesh, height):
    """Left: the same object ever farther away, shown at the same size; right: scales that vary over the image."""
    out = []
    for zoom in (1.0, 0.5, 0.25):
        g, _ = view(mesh, height, zoom=zoom)
        d = se.describe(g, sigma=1.5)
        margin = round(height * (1 - zoom) / 2)
        picture = colors(d, g, 60 / height / zoom)[margin : height - margin, margin : height - margin]
        factor = round(1 / zoom)
        out.append(fit(picture.repeat(factor, 0).repeat(factor, 1), height))
    g, _ = view(mesh, height)
    steps = jnp.asarray(np.clip(400 * (around(g, 0.4, 0.4) - 0.12), 0, 120), g.normal.dtype)
    return [*out, colors(se.describe(g, importance=steps), g, 60 / height)]


def figure_4_9(mesh, height):
    """(a) object-centred; view-centred with foreshortening (b) 0, (c) 0.5, (d) 1: above near, below far away."""
    rows = []
    for zoom in (1.0, 0.4):
        g, base = view(mesh, height, zoom=zoom)
        views = [base, *(se.describe(g, sigma=1.0, foreshortening=f) for f in (0.0, 0.5, 1.0))]
        rows.append(np.concatenate([colors(d, g, 60 / height) for d in views], axis=1))
    return [np.concatenate(rows, axis=0)]


def figure_4_10(_, height):
    """Coarse tessellation: a torus of few triangles with smooth normals, then more; facets show where normals bend."""
    out = []
    for segments in (6, 12, 24):
        ring = se.torus(major=1.0, minor=0.45, segments=segments)
        g, _ = view(ring, height)
        out += [shaded(g), colors(se.describe(g, sigma=1.0), g, 60 / height)]
    return out


def figure_directions(mesh, height):
    """Principal directions by line integral convolution: greatest curvature, least curvature (not in TH10)."""
    g, _ = view(mesh, height)
    d = se.describe(g, sigma=2.0)
    out = []
    for direction in se.principal_directions(d.hessian):
        strokes = np.asarray(se.line_integral_convolution(direction, mask=g.mask, length=0.08 * height))[..., None]
        out.append(colors(d, g, 60 / height) * (0.35 + 0.65 * strokes))
    return [*out, se.curvature_legend(height)]


def fit(picture, height):
    """Cropped or padded with white to a height and width."""
    out = np.ones((height, height, 3))
    h, w = min(height, picture.shape[0]), min(height, picture.shape[1])
    out[:h, :w] = picture[:h, :w]
    return out


FIGURES = {
    "fig_4_3": figure_4_3,
    "fig_4_5": figure_4_5,
    "fig_4_7": figure_4_7,
    "fig_4_9": figure_4_9,
    "fig_4_10": figure_4_10,
    "directions": figure_directions,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", nargs="?")
    parser.add_argument("-o", "--output", default="figures", metavar="FOLDER")
    parser.add_argument("--height", type=int, default=360)
    parser.add_argument("--only", choices=FIGURES)
    arguments = parser.parse_args()
    mesh = se.load_mesh(arguments.mesh) if arguments.mesh else se.carved_knot()
    folder = Path(arguments.output)
    folder.mkdir(parents=True, exist_ok=True)
    for name, draw in FIGURES.items():
        if arguments.only in (None, name):
            sheet = np.concatenate(draw(mesh, arguments.height), axis=1)
            se.save_image(folder / f"{name}.png", np.uint8(np.round(255 * np.clip(sheet, 0, 1))))


if __name__ == "__main__":
    main()
