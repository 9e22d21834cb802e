"""Descriptors side by side, after TH10 figs 4.3, 4.7 and 4.9: object-centred, relief, view-centred, scales, distance.

python examples/figures/th10_descriptors.py [MESH] [-o descriptors.png]
"""

import argparse

import jax.numpy as jnp
import numpy as np

import shapeenh as se


def picture(descriptor, mask, scale):
    return np.asarray(se.curvature_colors(descriptor, mask, scale=scale))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("mesh", nargs="?")
    parser.add_argument("-o", "--output", default="descriptors.png")
    parser.add_argument("--height", type=int, default=300)
    arguments = parser.parse_args()
    mesh = se.load_mesh(arguments.mesh) if arguments.mesh else se.carved_knot()
    height = arguments.height
    size = {"height": height, "width": height}
    camera = se.frame_mesh(mesh, direction=(0.34, 0.26, 0.9), aspect=1.0)
    g = se.render_gbuffer(mesh, camera, **size)
    scale = 60 / height

    # TH10 fig. 4.9: (a) object-centred; (b-d) view-centred, f = 0, 0.5, 1
    tensor = se.interpolate(se.vertex_curvature(mesh), mesh, camera, se.rasterize(mesh, camera, **size))
    plain = se.describe_object(g, tensor, camera)
    top = [picture(plain, g.mask, scale)]
    top += [picture(se.describe(g, sigma=1.0, foreshortening=f), g.mask, scale) for f in (0.0, 0.5, 1.0)]

    # fig. 4.3: relief; fig. 4.7: larger scales; fine detail kept around one place only
    relief = se.describe_relief(g, sigma=1.0, beta=-1.0, base=plain)
    row, column = np.mgrid[:height, :height] / height
    far = np.hypot(row - 0.4, column - 0.4)
    steps = jnp.asarray(np.clip(300 * (far - 0.15), 0, 80))
    bottom = [picture(relief, g.mask, 0.4)]
    bottom += [picture(se.describe(g, sigma=s), g.mask, scale) for s in (2.0, 5.0)]
    bottom += [picture(se.describe(g, importance=steps), g.mask, scale)]
    sheet = np.concatenate([np.concatenate(r, 1) for r in (top, bottom)], 0)
    se.save_image(arguments.output, np.uint8(np.round(255 * sheet)))


if __name__ == "__main__":
    main()
