"""Radiance in any direction: lookups in a latitude-longitude map, and its cosine convolution (SPEC 6 and 7).

The map's convention is SPEC 7's: world y up, the map's middle along -z. Directions are in the frame of the map.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh import checks, numerics


def _map_directions(height: int, width: int):
    """Unit directions [h, w, 3] of the pixel centres and solid angles [h, 1], float64."""
    theta = np.pi * (np.arange(height) + 0.5) / height
    phi = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    sin, cos = np.sin(theta)[:, None], np.cos(theta)[:, None]
    direction = np.stack([sin * np.sin(phi), np.broadcast_to(cos, (height, width)), -sin * np.cos(phi)], -1)
    return direction, 4 * np.pi / width * sin * np.sin(0.5 * np.pi / height)


def environment_radiance(radiance_map, direction):
    """Radiance that arrives from a direction: bilinear in a latitude-longitude map.

    Source: SPEC 5 (eq. 1) and 7. radiance_map: [h, w, 3], linear RGB. direction: [..., 3], unit, the frame of the map.
    Returns [..., 3]. Columns wrap around, rows end at the poles. NaN in the map counts as 0, infinite values as the
    largest finite one.
    Gradient: exact in the map, piecewise in the direction; 0 in the direction at the poles, where longitude is
    undefined.
    Errors: ValueError for other shapes.
    """
    checks.check_shape("radiance_map", radiance_map, (None, None, 3))
    checks.check_shape("direction", direction, (..., 3))
    dtype = checks.float_dtype(radiance_map, direction)
    return looked_up(finite_map(jnp.asarray(radiance_map, dtype)), jnp.asarray(direction, dtype))


def finite_map(radiance_map):
    """The map with 0 for NaN and -inf, and its largest finite value for +inf; no gradient there."""
    finite = jnp.isfinite(radiance_map)
    top = jnp.max(lax.stop_gradient(radiance_map), initial=0, where=finite)
    return jnp.where(finite, radiance_map, jnp.where(radiance_map == jnp.inf, top, 0))


def looked_up(texture, d):
    """`environment_radiance` of checked arrays, the map finite."""
    dtype = d.dtype
    height, width = texture.shape[:2]
    x, y, z = d[..., 0], d[..., 1], d[..., 2]
    across = numerics.safe_hypot(x, z)
    # Longitude has no derivative at a pole; so near it that its square is no number, it counts as one.
    pole = across < np.finfo(dtype).tiny ** 0.25
    phi = jnp.arctan2(jnp.where(pole, 0, x), jnp.where(pole, 1, -z))
    theta = jnp.arctan2(across, jnp.where(pole, jnp.where(y < 0, -1, 1), y))
    u, v = (phi / (2 * np.pi) + 0.5) * width - 0.5, theta / np.pi * height - 0.5
    left, top = jnp.floor(u), jnp.floor(v)
    fu, fv = (u - left)[..., None], (v - top)[..., None]
    column, row = left.astype(jnp.int32), top.astype(jnp.int32)
    columns = [(column + i) % width for i in (0, 1)]
    rows = [jnp.clip(row + i, 0, height - 1) for i in (0, 1)]
    texel = [[texture[r, c] for c in columns] for r in rows]
    upper, lower = (a + fu * (b - a) for a, b in texel)
    return upper + fv * (lower - upper)


# ------------------------------------------------------------------------------------------- diffuse light

# Real spherical harmonics up to order 2, in x, y, z, and the cosine's own coefficients (Ramamoorthi and Hanrahan 2001).
_COSINE = np.array([np.pi] + [2 * np.pi / 3] * 3 + [np.pi / 4] * 5)


def _harmonics(d, xp):
    x, y, z = d[..., 0], d[..., 1], d[..., 2]
    return xp.stack(
        [
            0.28209479177387814 * xp.ones_like(x),
            0.4886025119029199 * y,
            0.4886025119029199 * z,
            0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * z * z - 1),
            1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ],
        axis=-1,
    )


def spherical_harmonics(radiance_map):
    """Nine coefficients of a map's irradiance, Lbar(n) = integral L <n.l> dl / pi (Ramamoorthi and Hanrahan 2001).

    radiance_map: [h, w, 3]. Returns [9, 3], for `harmonic_radiance`. Within a few per cent of the convolution for maps
    without small bright lamps; `prefilter_map` has no such limit. NaN counts as 0, infinite values as the largest
    finite one.
    Gradient: linear in the map. Errors: ValueError for another shape.
    """
    checks.check_shape("radiance_map", radiance_map, (None, None, 3))
    dtype = checks.float_dtype(radiance_map)
    direction, solid = _map_directions(*np.shape(radiance_map)[:2])
    basis = (_harmonics(direction, np) * solid[..., None] * _COSINE / np.pi).reshape(-1, 9)
    weighted = jnp.asarray(basis, dtype)[:, :, None] * finite_map(jnp.asarray(radiance_map, dtype)).reshape(-1, 1, 3)
    return jnp.sum(weighted, axis=0)


def harmonic_radiance(coefficients, normal):
    """Lbar(n) >= 0 from the nine coefficients. coefficients: [9, 3]; normal: [..., 3], unit. Returns [..., 3]."""
    checks.check_shape("coefficients", coefficients, (9, 3))
    checks.check_shape("normal", normal, (..., 3))
    dtype = checks.float_dtype(coefficients, normal)
    basis, table = _harmonics(jnp.asarray(normal, dtype), jnp), jnp.asarray(coefficients, dtype)
    total = sum(basis[..., i, None] * jnp.broadcast_to(table[i], (*basis.shape[:-1], 3)) for i in range(9))
    return jnp.maximum(total, 0)


def prefilter_map(radiance_map, *, height=32):
    """The map convolved with the cosine: Lbar(n) = integral L <n.l> dl / pi, as a latitude-longitude map.

    Source: TH10 5.3.2, corrected (SPEC 15): cosine-weighted. radiance_map: [h, w, 3]. *Static*: height of the result.
    Returns [height, 2 height, 3], for `environment_radiance`; a constant map stays itself. NaN counts as 0, infinite
    values as the largest finite one.
    Gradient: linear in the map. Errors: ValueError for another shape or a height below 2.
    """
    checks.check_shape("radiance_map", radiance_map, (None, None, 3))
    height = checks.check_size("height", height, low=2, high=512)
    dtype = checks.float_dtype(radiance_map)
    source, solid = _map_directions(*np.shape(radiance_map)[:2])
    target, _ = _map_directions(height, 2 * height)
    weighted = finite_map(jnp.asarray(radiance_map, dtype)) * jnp.asarray(solid, dtype)[..., None] / np.pi
    source, target = (jnp.asarray(a, dtype) for a in (source.reshape(-1, 3), target))
    share = np.broadcast_to(solid / np.pi, np.shape(radiance_map)[:2]).reshape(-1, 1)
    table = jnp.concatenate([weighted.reshape(-1, 3), jnp.asarray(share, dtype)], axis=-1)

    @jax.checkpoint
    def convolve(row):
        # A row of the result at a time: all at once would be a table of the square of the map's size.
        cosine = jnp.maximum(jnp.matmul(row, source.T, precision="highest"), 0)
        return jnp.matmul(cosine, table, precision="highest")

    out = lax.map(convolve, target)
    # Divided by the cosine's own quadrature, so that a constant map stays constant.
    return out[..., :3] / out[..., 3:]
