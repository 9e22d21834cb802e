"""Which warp, and which light, made this picture? Alpha, gamma and the turn and colour of the light, from a picture.

python examples/fit_picture.py [MESH] [--env MAP] [-o fit_picture.png]
"""

import argparse

import jax.numpy as jnp
import numpy as np

import shapeenh as se

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("mesh", nargs="?", help="default: the embedded carved knot")
parser.add_argument("--env", help="a radiance map; default: the procedural studio")
parser.add_argument("-o", "--output", default="fit_picture.png")
arguments = parser.parse_args()

mesh = se.load_mesh(arguments.mesh) if arguments.mesh else se.carved_knot()
radiance_map = se.load_environment(arguments.env) if arguments.env else se.procedural_studio()
camera = se.frame_mesh(mesh, direction=(0.34, 0.26, 0.90), aspect=4 / 3)
gbuffer = se.render_gbuffer(mesh, camera, height=150, width=200)
lights = se.sample_environment(radiance_map, 54)
material = se.named_material("stone")


def turned(lights, angle):
    """The lights turned about the world's vertical axis."""
    x, y, z = lights.direction.T
    direction = [x * jnp.cos(angle) + z * jnp.sin(angle), y, z * jnp.cos(angle) - x * jnp.sin(angle)]
    return se.Lights(jnp.stack(direction, axis=-1), lights.radiance)


def render(scene):
    light = turned(lights, scene["turn"])
    light = se.Lights(light.direction, light.radiance * scene["colour"][None])
    return se.enhance(gbuffer, se.rotate_lights(light, camera), material, scene["warp"], sigma=2.0)


hidden = {"warp": se.LightWarp(33.0, 0.2), "turn": 0.5, "colour": jnp.array([1.2, 0.9, 0.6])}
picture = render(hidden)

start = {"warp": se.LightWarp(10.0, 0.0), "turn": 0.0, "colour": jnp.ones(3)}
bounds = {"warp": {"alpha": (0.0, 100.0), "gamma": (-1.0, 1.0)}, "turn": (-1.5, 1.5), "colour": (0.0, 3.0)}
fit = se.fit_image(render, picture, start, mask=gbuffer.mask, bounds=bounds)

found = fit.parameters
print(f"alpha {found['warp'].alpha:.3f} (33), gamma {found['warp'].gamma:.4f} (0.2), turn {found['turn']:.4f} (0.5)")
print(f"colour {np.round(found['colour'], 4)} ([1.2 0.9 0.6]); difference {fit.value:.1e}, {fit.renders} pictures")

exposure = se.auto_exposure(picture, gbuffer.mask)
panels = [se.tone_map(image, exposure=exposure) for image in (render(start), picture, render(found))]
grey = jnp.full(3, 0.78)
panels = [se.composite(panel, gbuffer.mask, grey) for panel in panels]
se.save_image(arguments.output, np.concatenate(panels, axis=1))
