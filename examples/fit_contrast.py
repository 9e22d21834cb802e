"""How strong must the warp be for a picture to have a wanted contrast?

python examples/fit_contrast.py [MESH] [--env MAP] [--target 0.8] [-o fit_contrast.png]
"""

import argparse

import jax.numpy as jnp
import numpy as np

import shapeenh as se

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("mesh", nargs="?", help="default: the embedded carved knot")
parser.add_argument("--env", help="a radiance map; default: the procedural studio")
parser.add_argument("--target", type=float, default=0.8, help="standard deviation over mean of the luminance")
parser.add_argument("-o", "--output", default="fit_contrast.png")
arguments = parser.parse_args()

mesh = se.load_mesh(arguments.mesh) if arguments.mesh else se.carved_knot()
radiance_map = se.load_environment(arguments.env) if arguments.env else se.procedural_studio()
camera = se.frame_mesh(mesh, direction=(0.34, 0.26, 0.90), aspect=4 / 3)
gbuffer = se.render_gbuffer(mesh, camera, height=300, width=400)
lights = se.rotate_lights(se.sample_environment(radiance_map, 54), camera)
material = se.named_material("stone")


def render(warp):
    return se.enhance(gbuffer, lights, material, warp, sigma=2.0)


plain = render(None)
print(f"plain: contrast {se.contrast(plain, gbuffer.mask):.4f}")

# The bounds name what may change; LightWarp's gamma would be held if it were left out.
fit = se.fit_contrast(
    render,
    arguments.target,
    se.LightWarp(alpha=20.0, gamma=0.0),
    mask=gbuffer.mask,
    bounds={"alpha": (0.0, 100.0), "gamma": (-1.0, 1.0)},
)
alpha, gamma = fit.parameters.alpha, fit.parameters.gamma
print(f"alpha {alpha:.2f}, gamma {gamma:.3f}: contrast {fit.value:.4f} after {fit.renders} pictures")

exposure = se.auto_exposure(plain, gbuffer.mask)
panels = [se.tone_map(image, exposure=exposure) for image in (plain, render(fit.parameters))]
grey = jnp.full(3, 0.78)
panels = [se.composite(panel, gbuffer.mask, grey) for panel in panels]
se.save_image(arguments.output, np.concatenate(panels, axis=1))
