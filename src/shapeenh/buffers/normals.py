"""Normal images: decoding, the side that they face, and a check of the direction that green means."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh.checks import check_choice, float_dtype, is_concrete
from shapeenh.numerics import norm, normalize

LEAST_NZ = 0.01  # SPEC 3.1; meshes are held there as well
STEEPEST = 4.0  # slopes beyond this say little about the convention
LEAST_EVIDENCE = 200  # pixels that the check of the convention needs
GREEN = ("up", "down")


def decode_normals(image, *, green: str = "up") -> jax.Array:
    """Unit normals from an image that stores them as colours, n = 2 c - 1.

    Red is x to the right, blue z towards the viewer; green is y up (OpenGL) or down (DirectX). Pixels that are 0 in all
    channels, that are transparent, or not finite, become the zero vector, which no surface has: `gbuffer_from_normals`
    leaves them off the mask.

    Args:
        image: [H, W, 3], or [H, W, 4] with alpha; uint8, uint16, or floats in [0, 1].
        green: "up" or "down".

    Returns: [H, W, 3], unit or zero.
    Gradient: with respect to a float image.
    Errors: ValueError for another shape, dtype or `green`. Warns for 8 bits: they show as steps in the curvature.

    >>> normal = se.decode_normals(se.load_image("relief.png"), green="down")
    """
    return decoded(image, green, stacklevel=3)


def decoded(image, green: str, *, stacklevel: int) -> jax.Array:
    """`decode_normals`, with the warning at the caller's line."""
    check_choice("green", green, GREEN)
    if len(np.shape(image)) != 3 or np.shape(image)[2] not in (3, 4):
        raise ValueError(f"image has shape {np.shape(image)}; accepted is [H, W, 3] or [H, W, 4]")
    image = image if isinstance(image, jax.Array) else np.asarray(image)
    if image.dtype not in (np.uint8, np.uint16) and not jnp.issubdtype(image.dtype, jnp.floating):
        raise ValueError(f"image has dtype {image.dtype}; accepted are uint8, uint16 and floats in [0, 1]")
    if image.dtype == np.uint8:
        warnings.warn(
            "8-bit normals are quantised to half a degree, which shows in curvature: use a sigma of 2 px or more "
            "(on gentle relief its error is then 2 %, at sigma 0 it is 22 %), or 16 bits",
            stacklevel=stacklevel,
        )
    return _decode(jnp.asarray(image), jnp.asarray(1 if green == "up" else -1))


@jax.jit
def _decode(image, y_sign):
    dtype = float_dtype(image)
    whole = jnp.iinfo(image.dtype).max if jnp.issubdtype(image.dtype, jnp.integer) else 1
    c = image.astype(dtype) * (1 / whole)
    there = jnp.all(jnp.isfinite(c), axis=-1) & jnp.any(c[..., :3] != 0, axis=-1)
    if c.shape[-1] == 4:
        there &= c[..., 3] > 0
    n = 2 * jnp.where(there[..., None], c[..., :3], 0.5) - 1
    n = n * jnp.stack([jnp.ones((), dtype), y_sign.astype(dtype), jnp.ones((), dtype)])[None, None]
    return normalize(n)


def turn_green(normal, green: str):
    """Float normals with y up."""
    check_choice("green", green, GREEN)
    return normal if green == "up" else normal * jnp.asarray([1, -1, 1], normal.dtype)[None, None]


def facing(normal):
    """Unit normals with n_z >= 0.01; for `[..., 3]` vectors that are not zero.

    As `render_gbuffer` has it: the descriptor's slopes stay finite, and a normal that looks past the view axis by a few
    degrees, as at the rim of a sphere, is seen from the side. A held n_z has no derivative.
    """
    n = normalize(normal)
    return normalize(jnp.concatenate([n[..., :2], jnp.maximum(n[..., 2:], LEAST_NZ)], axis=-1))


# ------------------------------------------------------------------------------------------- the convention
#
# The slopes p = dz/dx, q = dz/dy of a surface satisfy dp/dy = dq/dx. If green is read the wrong way round, q changes
# its sign and the equation becomes dp/dy = -dq/dx. Where there is any twist at all the sign of the correlation of
# dp/dy and dq/dx tells one from the other; noise is not correlated, and a surface without twist says nothing.


def warn_of_convention(normal, mask, green: str, what: str, *, stacklevel: int) -> None:
    """Warn where an image of normals contradicts what it is said to hold; looks at concrete values only.

    normal: [H, W, 3] as decoded, y up as far as `green` says so. mask: [H, W] bool. what: the argument's name.
    """
    if not is_concrete(normal, mask):
        return
    correlation, count, away, encoded = (float(v) for v in _evidence(normal, mask))
    if encoded > 0.5:
        warnings.warn(
            f"{what} has no negative x or y and is not unit: it looks like colours in [0, 1]; use decode_normals",
            stacklevel=stacklevel,
        )
    elif away > 0.5:
        warnings.warn(
            f"{what} has z < 0 at {100 * away:.0f} % of the pixels; z is expected towards the viewer",
            stacklevel=stacklevel,
        )
    elif count >= LEAST_EVIDENCE and correlation < -0.3:
        other = "down" if green == "up" else "up"
        warnings.warn(
            f"{what} fits no surface with green {green} (correlation {correlation:.2f}), but one with green {other}; "
            f"try green={other!r}",
            stacklevel=stacklevel,
        )


@jax.jit
def _evidence(normal, mask):
    """(correlation of dp/dy and dq/dx, pixels it rests on, share with n_z < 0, whether it looks encoded)."""
    good = mask & jnp.all(jnp.isfinite(normal), axis=-1) & (norm(normal) > 0)
    n = jnp.where(good[..., None], normal, jnp.asarray([0, 0, 1], normal.dtype))
    total = jnp.maximum(jnp.sum(good), 1)
    away = jnp.sum(good & (n[..., 2] < 0)) / total
    far = jnp.sum(good & (jnp.abs(norm(n) - 1) > 0.1)) / total
    encoded = jnp.where(jnp.all(n[..., :2] >= 0), far, 0)

    z = jnp.maximum(n[..., 2], 1e-3)
    p, q = -n[..., 0] / z, -n[..., 1] / z
    usable = good & (p * p + q * q < STEEPEST**2)
    block = usable[:-1, :-1] & usable[1:, :-1] & usable[:-1, 1:] & usable[1:, 1:]
    py = 0.5 * (p[:-1, :-1] + p[:-1, 1:] - p[1:, :-1] - p[1:, 1:])
    qx = 0.5 * (q[:-1, 1:] + q[1:, 1:] - q[:-1, :-1] - q[1:, :-1])
    limit = 0.5  # a larger change from pixel to pixel is an edge
    block &= (jnp.abs(py) < limit) & (jnp.abs(qx) < limit)
    py, qx = jnp.where(block, py, 0), jnp.where(block, qx, 0)
    energy = jnp.sum(py * py) * jnp.sum(qx * qx)
    correlation = jnp.where(energy > 0, jnp.sum(py * qx) * jax.lax.rsqrt(jnp.maximum(energy, 1e-30)), 0)
    return correlation, jnp.sum(block & ((py != 0) | (qx != 0))), away, encoded
