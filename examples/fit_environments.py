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
parser.add_argument("--other", help="another; default: the first one, turned round")
parser.add_argument("-o", "--output", default="fit_environments.png")
arguments = parser.parse_args()

mesh = se.load_mesh(arguments.mesh) if arguments.mesh else se.carved_knot()
first = se.load_environment(arguments.env) if arguments.env else se.procedural_studio()
other, turn = (se.load_environment(arguments.other), 0.0) if arguments.other else (first, np.pi)
camera = se.frame_mesh(mesh, direction=(0.34, 0.26, 0.90), aspect=4 / 3)
gbuffer = se.render_gbuffer(mesh, camera, height=300, width=400)
first, other = (
    se.rotate_lights(se.sample_environment(m, 54, rotation=angle), camera) for m, angle in ((first, 0.0), (other, turn))
)
material = se.named_material("stone")


def render(warp, lights):
    return se.enhance(gbuffer, lights, material, warp, sigma=2.0)


BOUNDS = {"alpha": (0.0, 200.0), "gamma": (-1.0, 1.0)}
wanted, before = (se.contrast(render(se.LightWarp(30.0), lights), gbuffer.mask) for lights in (first, other))
print(f"the first environment with alpha 30: contrast {wanted:.4f}; the other one: {before:.4f}")


def fitted(names, lights):
    """The warp that gives the wanted contrast under `lights`; what `names` leaves out stays as it was."""
    bounds = {name: BOUNDS[name] for name in names}
    return se.fit_contrast(
        render, wanted, se.LightWarp(30.0, 0.0), mask=gbuffer.mask, bounds=bounds, arguments=(lights,)
    )


for names in (("alpha",), ("alpha", "gamma")):
    try:
        fit = fitted(names, other)
        break
    except ValueError as out_of_reach:  # it says which contrasts can be reached
        print(f"{' and '.join(names)} alone: {out_of_reach}")
else:
    parser.exit(1)
print(f"alpha {fit.parameters.alpha:.2f}, gamma {fit.parameters.gamma:.3f} give it, after {fit.renders} pictures")


def strength_under(brightness):
    """Brightness of the other environment's strongest light -> the last of `names`, through the fit."""
    strongest = jnp.argmax(jnp.sum(other.radiance, axis=1))
    radiance = other.radiance * jnp.where(jnp.arange(54) == strongest, brightness, 1.0)[:, None]
    return getattr(fitted(names, se.Lights(other.direction, radiance)).parameters, names[-1])


print(f"a strongest light brighter by 1 % asks for {0.01 * jax.grad(strength_under)(1.0):+.5f} of {names[-1]}")

grey, panels = jnp.full(3, 0.78), []
for image in (render(se.LightWarp(30.0), first), render(se.LightWarp(30.0), other), render(fit.parameters, other)):
    shown = se.tone_map(image, exposure=se.auto_exposure(image, gbuffer.mask))
    panels.append(se.composite(shown, gbuffer.mask, grey))
se.save_image(arguments.output, np.concatenate(panels, axis=1))
