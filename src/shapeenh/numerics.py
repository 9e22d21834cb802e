"""Gradient-safe primitives. Each says its value and its gradient at the bad point, and why plain code will not do.

Symmetric 2x2 tensors are `[..., 3]` arrays (xx, xy, yy). Imports nothing of ours.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero

# ------------------------------------------------------------------------------------------- roots and quotients


def safe_divide(a, b):
    """a / b, and 0 with zero gradients where b == 0 (plain division gives inf or NaN there, and 0 * inf in reverse).

    The derivative is (da - (a/b) db)/b: JAX's own divides by b^2, which is 0 for |b| < 1e-22 in float32.
    """
    dtype = jnp.result_type(a, b)
    return _quotient(jnp.asarray(a, dtype), jnp.asarray(b, dtype))


@jax.custom_jvp
def _quotient(a, b):
    zero = b == 0
    return jnp.where(zero, 0, a / jnp.where(zero, 1, b))


@functools.partial(_quotient.defjvp, symbolic_zeros=True)
def _quotient_jvp(primals, tangents):
    (a, b), (da, db) = primals, tangents
    q = _quotient(a, b)
    change = -q * db if isinstance(da, SymbolicZero) else da if isinstance(db, SymbolicZero) else da - q * db
    change = jnp.zeros_like(q) if isinstance(change, SymbolicZero) else jnp.broadcast_to(change, q.shape)
    zero = b == 0
    return q, jnp.where(zero, 0, change / jnp.where(zero, 1, b))


def safe_sqrt(x):
    """sqrt(x), and 0 with gradient 0 where x <= 0 (the true derivative is infinite there and poisons chained zeros)."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def safe_power(x, exponent):
    """x ** exponent for x >= 0; 0 with zero gradients where x <= 0, for every exponent, zero included.

    As a reflectance lobe, light from behind the surface stays dark even with exponent 0. Plain `x ** p` has
    d/dx = inf at 0 for p < 1 and d/dp = 0 * log 0 = NaN.
    """
    positive = x > 0
    return jnp.where(positive, jnp.exp(exponent * jnp.log(jnp.where(positive, x, 1))), 0)


@jax.custom_jvp
def safe_hypot(x, y):
    """sqrt(x^2 + y^2) without overflow or underflow; 0 with gradient 0 at the origin (plain hypot gives NaN there).

    For a function that is even in the radius, such as any spectral function of a 2x2 tensor at an umbilic, the zero is
    the exact derivative, not a convention.
    """
    ax, ay = jnp.abs(x), jnp.abs(y)
    big, small = jnp.maximum(ax, ay), jnp.minimum(ax, ay)
    ratio = small / jnp.where(big == 0, 1, big)
    return big * jnp.sqrt(1 + ratio * ratio)


@safe_hypot.defjvp
def _safe_hypot_jvp(primals, tangents):
    (x, y), (dx, dy) = primals, tangents
    r = safe_hypot(x, y)
    s = jnp.where(r == 0, 1, r)
    return r, (x / s) * dx + (y / s) * dy


def norm(v, axis: int = -1, keepdims: bool = False):
    """Euclidean length of vectors of a few components, scaled against overflow; 0 with gradient 0 for the zero vector
    (plain norm gives NaN). Component by component: XLA's reductions of short axes are many times slower on CPU."""
    components = [lax.index_in_dim(v, i, axis) for i in range(v.shape[axis])]
    big = lax.stop_gradient(functools.reduce(jnp.maximum, map(jnp.abs, components)))
    big = jnp.where(big > 0, big, 1)
    length = safe_sqrt(sum((t / big) ** 2 for t in components)) * big
    return length if keepdims else jnp.squeeze(length, axis)


def normalize(v, axis: int = -1):
    """v / |v|; the zero vector stays zero, with zero gradients (plain division gives NaN)."""
    return safe_divide(v, norm(v, axis, keepdims=True))


# ------------------------------------------------------------------------------------------- symmetric 2x2 tensors


def _halves(x):
    """x = high + low with so few bits each that the product of any two halves is exact.

    By a bit mask: Dekker's splitting by arithmetic does not survive a compiler that fuses multiply and add, while
    exact products make fused and unfused sums equal.
    """
    word, keep = (jnp.uint32, 0xFFFFF000) if x.dtype == np.float32 else (jnp.uint64, 0xFFFFFFFFF8000000)
    high = lax.bitcast_convert_type(lax.bitcast_convert_type(x, word) & np.array(keep, word), x.dtype)
    return high, x - high


def _power_of_two(x):
    """The largest power of two that is not above x >= 0 (1 for x = 0): scaling by it is exact."""
    word, keep = (jnp.uint32, 0x7F800000) if x.dtype == np.float32 else (jnp.uint64, 0x7FF0000000000000)
    p = lax.bitcast_convert_type(lax.bitcast_convert_type(x, word) & np.array(keep, word), x.dtype)
    return jnp.where(p == 0, 1, p)


def _two_sum(a, b):
    """a + b = s + e, exactly (Knuth)."""
    s = a + b
    t = s - a
    return s, (a - (s - t)) + (b - t)


def _exact_determinant(xx, xy, yy):
    """xx yy - xy^2 as if computed in twice the precision and then rounded; entries of order one."""
    (ah, al), (bh, bl), (ch, cl) = _halves(xx), _halves(xy), _halves(yy)
    s1, e1 = _two_sum(ah * ch, -bh * bh)
    s2, e2 = _two_sum(ah * cl, al * ch)
    s3, e3 = _two_sum(s2, -2 * bh * bl)
    s, e = _two_sum(s1, s3)
    return s + (e + ((e1 + e2) + (e3 + (al * cl - bl * bl))))


def _plain_eigenvalues(tensor):
    xx, xy, yy = tensor[..., 0], tensor[..., 1], tensor[..., 2]
    mean = 0.5 * xx + 0.5 * yy
    r = safe_hypot(0.5 * xx - 0.5 * yy, xy)
    return mean + r, mean - r


@jax.custom_jvp
def eigenvalues(tensor):
    """(k1, k2), k1 >= k2, of `[..., 3]` tensors: Hm ± r (SPEC 3.8), both to full relative precision.

    Hm - r cancels: in float32 it leaves nothing of a curvature 1e-7 times the other one, which a strong warp shows.
    So the smaller one is det / larger one, with a determinant of doubled precision.
    Gradient: exact off umbilics; at an umbilic the derivative of r is taken as 0, so that every symmetric function of
    (k1, k2) has its exact gradient there.
    """
    planes = [tensor[..., i] for i in range(3)]
    scale = _power_of_two(functools.reduce(jnp.maximum, map(jnp.abs, planes)))
    xx, xy, yy = (t / scale for t in planes)
    mean = 0.5 * xx + 0.5 * yy
    r = safe_hypot(0.5 * xx - 0.5 * yy, xy)
    large = mean + jnp.where(mean < 0, -r, r)
    small = _exact_determinant(xx, xy, yy) / jnp.where(large == 0, 1, large)
    return jnp.maximum(large, small) * scale, jnp.minimum(large, small) * scale


@eigenvalues.defjvp
def _eigenvalues_jvp(primals, tangents):
    return eigenvalues(*primals), jax.jvp(_plain_eigenvalues, primals, tangents)[1]


def matrix_function(tensor, f: Callable, divided_difference: Callable):
    """F(H) = mean(f(k1), f(k2)) I + f[k1, k2] (H - Hm I), without eigenvectors (SPEC 3).

    `divided_difference(k1, k2)` is (f(k1) - f(k2)) / (k1 - k2), with its limit f'(k) at k1 = k2; written out by the
    caller in a form that does not cancel. Smooth at umbilics, and so are its gradients; eigenvectors are not.
    """
    xx, xy, yy = tensor[..., 0], tensor[..., 1], tensor[..., 2]
    k1, k2 = eigenvalues(tensor)
    mean = 0.5 * f(k1) + 0.5 * f(k2)
    slope = divided_difference(k1, k2)
    deviation = slope * (0.5 * xx - 0.5 * yy)
    return jnp.stack([mean + deviation, slope * xy, mean - deviation], axis=-1)


def determinant(tensor):
    """xx yy - xy^2 of `[..., 3]` tensors; entries are clamped so that the products stay finite (gradient 0 beyond)."""
    bound = 0.5 * jnp.sqrt(jnp.finfo(tensor.dtype).max)
    t = jnp.clip(tensor, -bound, bound)
    return t[..., 0] * t[..., 2] - t[..., 1] * t[..., 1]


# ------------------------------------------------------------------------------------------- steps


def smoothstep(low, high, x):
    """Hermite step: 0 below `low`, 1 above `high`, 3t^2 - 2t^3 between; its gradient is 0 at both ends."""
    t = jnp.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def luminance(rgb):
    """Rec. 709 luminance of linear RGB `[..., 3]`."""
    return 0.2126 * rgb[..., 0] + 0.7152 * rgb[..., 1] + 0.0722 * rgb[..., 2]


# ------------------------------------------------------------------------------------------- directions


def sphere_directions(count: int) -> np.ndarray:
    """[count, 3] directions that share the sphere equally: the golden spiral."""
    k = np.arange(count) + 0.5
    z, phi = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)
