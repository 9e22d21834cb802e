"""One carved ball as five kinds of input: mesh, normal-mapped mesh, image of normals, height field, point cloud.

python examples/inputs.py [-o inputs.png] [--size 300]

Prints how far the normals and the curvature of each are from the mesh's, where the surface faces the viewer.
"""

import argparse
import tempfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import shapeenh as se
from shapeenh.codecs import srgb_encode

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("-o", "--output", default="inputs.png")
parser.add_argument("--size", type=int, default=300, help="pixels per panel (default: 300)")
arguments = parser.parse_args()
size = arguments.size


# ------------------------------------------------------------------------------------------- the shape
# A ball of radius 1 + relief(u, v), u around, v from pole to pole; the relief fades out at the poles.


def relief(u, v):
    around, up = 2 * np.pi * u, np.pi * v
    waves = np.cos(12 * around + 6 * np.sin(2 * up)) * np.cos(14 * up) + 0.6 * np.cos(5 * around - 10 * up)
    return 0.022 * waves * np.sin(up) ** 2


def on_ball(u, v):
    azimuth, polar = 2 * np.pi * u, np.pi * (1 - v)
    return np.stack([np.sin(polar) * np.sin(azimuth), np.cos(polar), np.sin(polar) * np.cos(azimuth)], axis=-1)


def carved(u, v):
    return (1 + relief(u, v))[..., None] * on_ball(u, v)


def unit(a):
    return a / np.linalg.norm(a, axis=-1, keepdims=True)


def carved_normal(u, v, step=1e-5):
    along_u = carved(u + step, v) - carved(u - step, v)
    along_v = carved(u, v + step) - carved(u, v - step)
    return unit(np.cross(along_u, along_v))


def grid(columns, rows):
    """(u, v, faces) of a sheet that is wrapped round the ball."""
    u, v = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0.002, 0.998, rows + 1))
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    a = i * (columns + 1) + j
    b, c, d = a + 1, a + columns + 2, a + columns + 1
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)
    return u.reshape(-1), v.reshape(-1), faces


# ------------------------------------------------------------------------------------------- five inputs
# All are seen by the same orthographic camera, straight from the front, as images of normals and heights are.

camera = se.orthographic_camera((0, 0, 4), (0, 0, 0), height=2.2, aspect=1.0)
pixel = 2.2 / size
inputs = {}

u, v, faces = grid(900, 450)
mesh = se.make_mesh(carved(u, v), faces, normals=carved_normal(u, v))
inputs["mesh"] = se.render_gbuffer(mesh, camera, height=size, width=size)

# A plain ball with the relief in a normal map: the carved normals in the frame of the ball.
u, v, faces = grid(200, 100)
ball = se.make_mesh(on_ball(u, v), faces, normals=on_ball(u, v), uv=np.stack([u, v], axis=-1))
texel_u, texel_v = np.meshgrid((np.arange(2048) + 0.5) / 2048, 1 - (np.arange(1024) + 0.5) / 1024)
n = on_ball(texel_u, texel_v)
t = unit(np.stack([n[..., 2], np.zeros_like(texel_u), -n[..., 0]], axis=-1))
frame = np.stack([t, np.cross(n, t), n], axis=-2)
normal_map = np.einsum("hwkc,hwc->hwk", frame, carved_normal(texel_u, texel_v))
seen = se.rasterize(ball, camera, height=size, width=size)
smooth = se.render_gbuffer(ball, camera, height=size, width=size)
inputs["normal map"] = se.apply_normal_map(smooth, ball, camera, seen, normal_map.astype(np.float32))

# Images go through files, as those of a user would: 16-bit PNG and float TIFF.
exact = inputs["mesh"]
mask = np.asarray(exact.mask)[..., None]
with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "normals.png"
    se.save_image(path, np.where(mask, np.round((np.asarray(exact.normal) + 1) / 2 * 65535), 0).astype(np.uint16))
    inputs["normals"] = se.gbuffer_from_normals(se.load_image(path), spacing=pixel)
    path = Path(folder) / "relief.tif"
    se.save_image(path, np.where(mask[..., 0], -np.asarray(exact.depth), np.nan).astype(np.float32))
    inputs["height"] = se.gbuffer_from_height(se.load_image(path), spacing=pixel)

# Points without normals, at random on the ball, evenly in area.
rng = np.random.default_rng(1)
u, v = rng.random(150_000), 1 - np.arccos(rng.uniform(-1, 1, 150_000)) / np.pi
inputs["points"] = se.gbuffer_from_points(carved(u, v), None, None, camera, height=size, width=size)

# ------------------------------------------------------------------------------------------- compared, and drawn

curvature = {name: np.asarray(se.mean_curvature(se.describe(g, sigma=1.0).hessian)) for name, g in inputs.items()}
facing = np.asarray(exact.normal)[..., 2] > 0.5
scale = np.std(curvature["mesh"][facing])
print("input        normals apart, degrees: median, 95 %    curvature apart, of its spread: median, 95 %")
for name, g in inputs.items():
    both = facing & np.asarray(g.mask)
    chord = np.linalg.norm(np.asarray(g.normal) - np.asarray(exact.normal), axis=-1)[both]
    angle = np.degrees(2 * np.arcsin(np.clip(chord / 2, 0, 1)))
    apart = np.abs(curvature[name] - curvature["mesh"])[both] / scale
    print(
        f"{name:12s} {np.median(angle):24.3f} {np.quantile(angle, 0.95):9.3f}"
        f" {np.median(apart):31.3f} {np.quantile(apart, 0.95):9.3f}"
    )

lights = se.rotate_lights(se.sample_environment(se.procedural_studio(), 54), camera)
material = se.named_material("stone")
grey = jnp.full(3, 0.78)
exposure = se.auto_exposure(se.enhance(exact, lights, material), exact.mask)
rows = []
for g in inputs.values():
    panels = [
        np.where(g.mask[..., None], 0.5 + 0.5 * g.normal, 1),
        se.curvature_colors(se.describe(g, sigma=1.0), g.mask),
    ]
    for warp in (None, se.LightWarp(alpha=60.0)):
        lit = se.tone_map(se.enhance(g, lights, material, warp, sigma=2.0), exposure=exposure)
        panels.append(srgb_encode(np.asarray(se.composite(lit, g.mask, grey))))
    rows.append(np.concatenate([np.asarray(p) for p in panels], axis=1))
picture = np.round(255 * np.clip(np.concatenate(rows), 0, 1)).astype(np.uint8)  # display values: saved as they are
se.save_image(arguments.output, picture)
