"""From world space to window coordinates: where the rasteriser leaves floating point (SPEC 11).

Window coordinates are integers: 1/256 pixel, pixel centres at multiples of 256, x right, y down. Two faces that share
an edge see the same integers there, so whatever is decided from them is decided alike.

Depth is *nearness* r, larger = nearer, affine in window coordinates under perspective and orthographic cameras alike:
r = (w - z)/w under perspective, which an infinite far plane turns into 2 near/w, so that float32 keeps its *relative*
precision at every distance; under orthographic cameras r = -z without its constant part, so that a camera far away
or a far plane far away costs no precision.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax

SUB = 8  # bits of a pixel's fraction
ONE = 1 << SUB
GUARD = (
    1 << 24
)  # window coordinates up to here are exact integers in float32; edges beyond are cut from homogeneous points
FAR_OFF = 1 << 26  # what lies further out is held here: enough to know on which side of the image it is
BEHIND = 1 << 30  # x of a vertex on the eye's side of the near plane


def clip_matrix(view, projection):
    """Rows (x, y, nearness, w) of world -> clip, and the nearness / w of the near plane.

    w - z is formed before the product with the view: afterwards the difference would cancel.
    """
    rows = jnp.stack([projection[0], projection[1], projection[3] - projection[2], projection[3]])
    m = jnp.matmul(rows, view, precision=lax.Precision.HIGHEST)
    parallel = jnp.all(m[3, :3] == 0)
    constant = jnp.where(parallel, m[2, 3], 0)
    near = 2 - constant / jnp.where(parallel, m[3, 3], 1)
    return m.at[2, 3].add(-constant), near


def transform(vertices, m):
    """(x, y, nearness, w) planes [V]. Explicit sums: XLA:CPU's matrix product is 12 times slower."""
    x, y, z = vertices[:, 0], vertices[:, 1], vertices[:, 2]
    return tuple(m[k, 0] * x + m[k, 1] * y + m[k, 2] * z + m[k, 3] for k in range(4))


def window(cx, cy, w, height, width):
    """Window coordinates, not yet rounded, of points with w > 0."""
    scale_x, scale_y = w.dtype.type(width * ONE / 2), w.dtype.type(height * ONE / 2)
    inverse = 1 / w
    return (cx * inverse + 1) * scale_x - ONE // 2, (1 - cy * inverse) * scale_y - ONE // 2


def snap(value):
    """To the nearest 1/256 pixel."""
    return lax.convert_element_type(jnp.clip(jnp.rint(value), -FAR_OFF, FAR_OFF), jnp.int32)


def project(vertices, m, near, height, width):
    """Snapped corners [3, V] int32: x, y, and the bits of the float32 nearness. x = BEHIND for what the near plane cuts
    off, and for NaN vertices: every comparison with them is false."""
    cx, cy, c, w = transform(vertices, m)
    seen = (w > 0) & (c <= near * w)
    w = jnp.where(seen, w, 1)
    x, y = window(cx, cy, w, height, width)
    r = lax.bitcast_convert_type(lax.convert_element_type(c / w, jnp.float32), jnp.int32)
    return jnp.stack([jnp.where(seen, snap(x), BEHIND), snap(y), r])


def nearness(bits):
    return lax.bitcast_convert_type(bits, jnp.float32)


def nearness_shift(corners):
    """What to subtract from every nearness so that none is negative: its bits then sort as integers do."""
    return jnp.min(jnp.where(corners[0] == BEHIND, 0, nearness(corners[2])), initial=np.float32(0))


# ------------------------------------------------------------------------------------------- three vertices at a time


def three(function, values):
    return function(function(values[0], values[1]), values[2])


def pixel_box(x, y, height, width):
    """First and last pixel centre of three snapped vertices that lies in the image: x0, x1, y0, y1."""
    low_x, high_x = three(jnp.minimum, x), three(jnp.maximum, x)
    low_y, high_y = three(jnp.minimum, y), three(jnp.maximum, y)
    return (
        jnp.maximum((low_x + (ONE - 1)) >> SUB, 0),
        jnp.minimum(high_x >> SUB, width - 1),
        jnp.maximum((low_y + (ONE - 1)) >> SUB, 0),
        jnp.minimum(high_y >> SUB, height - 1),
    )


def double_area(x, y):
    """Twice the signed area; y points down, so a front (counter-clockwise) face has a negative one."""
    return (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])


def faces_viewer(area, cull):
    """Whether a face of this signed area is drawn; one without area never is."""
    return {"back": area < 0, "front": area > 0, "none": area != 0}[cull]


def top_left(a, b):
    """Whether an edge whose inside is towards +a x + b y keeps the pixel centres on it: a left edge, or a horizontal
    top edge (y down). Of the two faces at an edge exactly one does."""
    return (a > 0) | ((a == 0) & (b > 0))
