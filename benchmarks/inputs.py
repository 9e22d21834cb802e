"""What it costs to make a G-buffer from images and points, and to decode files: `python -m benchmarks.inputs`.

Gradients are of a sum over depth and normals, with respect to the input. Points lie at random on a ball that fills the
image; `radius` is in units of their mean distance.
"""

from __future__ import annotations

import argparse

import jax
import jax.numpy as jnp
import numpy as np

import shapeenh as se
from benchmarks import harness
from shapeenh import codecs

SIZES = ((600, 800), (1080, 1920))


def relief(height, width):
    y, x = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    return (20 * np.sin(x / 30) * np.cos(y / 25) + 5 * np.sin((x + y) / 7)).astype(np.float32)


def total(gbuffer):
    return jnp.sum(gbuffer.depth) + jnp.sum(gbuffer.normal[..., 0])


def image_calls(height, width):
    z = jnp.asarray(relief(height, width))
    n = se.gbuffer_from_height(z).normal
    slope_z = jax.jit(jax.grad(lambda z: total(se.gbuffer_from_height(z))))
    slope_n = jax.jit(jax.grad(lambda n: total(se.gbuffer_from_normals(n))))
    return {
        "height": lambda: se.gbuffer_from_height(z).normal,
        "height, gradient": lambda: slope_z(z),
        "normals": lambda: se.gbuffer_from_normals(n, check=False).normal,
        "normals, checked": lambda: se.gbuffer_from_normals(n).normal,
        "normals, gradient": lambda: slope_n(n),
    }


def point_calls(count, radius, height, width):
    points = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
    points = jnp.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))
    r = jnp.full(count, radius * np.sqrt(4 * np.pi / count), jnp.float32)
    camera = se.perspective_camera((0, 0, 4.2), (0, 0, 0), fov_degrees=30.0, aspect=width / height)

    def draw(points, normals, radius):
        return se.gbuffer_from_points(points, normals, radius, camera, height=height, width=width)

    slope = jax.jit(jax.grad(lambda *a: total(draw(*a)), argnums=(0, 1, 2)))
    name = f"{count // 1000}k points, radius {radius:g}"
    return {name: lambda: draw(points, points, r).normal, f"{name}, gradient": lambda: slope(points, points, r)}


def file_calls(height, width):
    z = relief(height, width)
    rgb = np.stack([z, z[::-1], z[:, ::-1]], axis=-1)
    deep = np.round((rgb - rgb.min()) * (65535 / np.ptp(rgb))).astype(np.uint16)
    png, hdr, tif = codecs.encode_png(deep), codecs.encode_hdr(np.abs(rgb)), codecs.encode_tiff(z)
    return {
        "decode 16-bit RGB PNG": lambda: codecs.decode_png(png),
        "encode 16-bit RGB PNG": lambda: codecs.encode_png(deep),
        "decode HDR": lambda: codecs.decode_hdr(hdr),
        "encode HDR": lambda: codecs.encode_hdr(np.abs(rgb)),
        "decode float TIFF": lambda: codecs.decode_tiff(tif),
        "encode float TIFF": lambda: codecs.encode_tiff(z),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    rows = []
    for height, width in SIZES:
        calls = image_calls(height, width)
        for count, radius in ((30_000, 2.0), (100_000, 2.0)):
            calls |= point_calls(count, radius, height, width)
        calls |= file_calls(height, width)
        for name, times in harness.measure(calls, repeats=repeats, seconds=60).items():
            rows.append({"what": name, "size": f"{width}x{height}", **times})
    print(harness.table(rows))
    print(harness.write("inputs", rows))


if __name__ == "__main__":
    main()
