"""A mesh that moves: same topology, new vertices in every frame, compiled once.

python examples/sequence.py [MESH] [--frames 6] [--size 240] [-o sequence.png]

Prints the time of every frame; the first one holds the compilation. The picture is a strip of the frames.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np

import shapeenh as se

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("mesh", nargs="?", help="default: the embedded carved knot")
parser.add_argument("--frames", type=int, default=6)
parser.add_argument("--size", type=int, default=240, help="pixels per frame (default: 240)")
parser.add_argument("-o", "--output", default="sequence.png")
arguments = parser.parse_args()

mesh = se.load_mesh(arguments.mesh) if arguments.mesh else se.carved_knot()
camera = se.frame_mesh(mesh, direction=(0.3, 0.3, 1.0), aspect=1.0, margin=0.15)
lights = se.rotate_lights(se.sample_environment(se.procedural_studio(), 54), camera)
material = se.named_material("stone")
low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
span = (high - low).max()


@jax.jit
def twist(vertices, angle):
    """Turned about the vertical axis, the further up the more."""
    centred = vertices - 0.5 * (low + high)[None]
    a = angle * centred[:, 1] / span
    x, z = centred[:, 0], centred[:, 2]
    turned = jnp.stack([jnp.cos(a) * x + jnp.sin(a) * z, centred[:, 1], jnp.cos(a) * z - jnp.sin(a) * x], axis=1)
    return turned + 0.5 * (low + high)[None]


frames, exposure = [], None
for k in range(arguments.frames):
    start = time.perf_counter()
    vertices = twist(mesh.vertices, 1.5 * np.sin(2 * np.pi * k / arguments.frames))
    moved = se.Mesh(vertices, mesh.faces, se.vertex_normals(vertices, mesh.faces), mesh.colors, mesh.uv)
    gbuffer = se.render_gbuffer(moved, camera, height=arguments.size, width=arguments.size)
    image = se.enhance(gbuffer, lights, material, se.LightWarp(alpha=40.0), sigma=2.0)
    exposure = se.auto_exposure(image, gbuffer.mask) if exposure is None else exposure  # of the first: no flicker
    frame = se.composite(se.tone_map(image, exposure=exposure), gbuffer.mask, jnp.full(3, 0.78))
    frames.append(np.asarray(frame))
    print(f"frame {k}: {1e3 * (time.perf_counter() - start):7.1f} ms")
se.save_image(arguments.output, np.concatenate(frames, axis=1))
