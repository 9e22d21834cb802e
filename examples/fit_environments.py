"""The strength that gives the same contrast under another environment, and how it follows a change of the light.

python examples/fit_environments.py [MESH] [--env MAP] [--other MAP] [-o fit_environments.png]
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np

import shapeenh as se

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("mesh", nargs="?", help="default: the embedded carved knot")
parser.add_argument("--env", help="a radiance map; default: the procedural studio")
parser.add_argument("--other", help="another; default: the procedural sky")
parser.add_argument("-o", "--output", default="fit_environments.png")
arguments = parser.parse_args()

mesh = se.load_mesh(arguments.mesh) if arguments.mesh else se.carved_knot()
first = se.load_environment(arguments.env) if arguments.env else se.procedural_studio()
other = se.load_environment(arguments.other) if arguments.other else se.procedural_sky()
camera = se.frame_mesh(mesh, direction=(0.34, 0.26, 0.90), aspect=4 / 3)
gbuffer = se.render_gbuffer(mesh, camera, height=300, width=400)
first, other = (se.rotate_lights(se.sample_environment(m, 54), camera) for m in (first, other))
material = se.named_material("stone")


def render(warp, lights):
    return se.enhance(gbuffer, lights, material, warp, sigma=2.0)


def fitted(lights):
    """The warp that gives under `lights` the contrast that the first environment gives with alpha = 30."""
    target = se.contrast(render(se.LightWarp(30.0), first), gbuffer.mask)
    bounds = {"alpha": (0.0, 200.0), "gamma": (-1.0, 1.0)}
    start = se.LightWarp(30.0, 0.0)
    return se.fit_contrast(render, target, start, mask=gbuffer.mask, bounds=bounds, arguments=(lights,))


before = se.contrast(render(se.LightWarp(30.0), other), gbuffer.mask)
fit = fitted(other)
alpha, gamma = fit.parameters.alpha, fit.parameters.gamma
print(f"the other environment with alpha 30: contrast {before:.4f}; wanted {fit.value:.4f}")
print(f"alpha {alpha:.2f}, gamma {gamma:.3f} give it, after {fit.renders} pictures")


def gamma_under(brightness):
    """Brightness of the other environment's strongest light -> gamma, through the fit."""
    strongest = jnp.argmax(jnp.sum(other.radiance, axis=1))
    radiance = other.radiance * jnp.where(jnp.arange(54) == strongest, brightness, 1.0)[:, None]
    return fitted(se.Lights(other.direction, radiance)).parameters.gamma


print(f"a strongest light brighter by 1 % asks for {0.01 * jax.grad(gamma_under)(1.0):+.5f} of gamma")

grey, panels = jnp.full(3, 0.78), []
for image in (render(se.LightWarp(30.0), first), render(se.LightWarp(30.0), other), render(fit.parameters, other)):
    shown = se.tone_map(image, exposure=se.auto_exposure(image, gbuffer.mask))
    panels.append(se.composite(shown, gbuffer.mask, grey))
se.save_image(arguments.output, np.concatenate(panels, axis=1))
