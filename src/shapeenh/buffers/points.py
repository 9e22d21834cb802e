"""Point clouds as oriented discs (SPEC 2): surface splatting after Zwicker et al. 2001 and Botsch et al. 2005."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.buffers.estimate import estimate_normals, estimate_radius
from shapeenh.buffers.inputs import check_camera
from shapeenh.buffers.normals import facing
from shapeenh.buffers.pairs import from_tiles, pixel_offsets, tile_boxes, to_tiles
from shapeenh.buffers.splat import (
    COLOR,
    NORMAL,
    REACH,
    SLACK,
    depth_at,
    disc_sums,
    meet,
    visible_discs,
    without_hidden,
)
from shapeenh.buffers.visibility import CULL
from shapeenh.checks import check_finite, check_range, check_shape, check_size, check_type, float_dtype, is_concrete
from shapeenh.numerics import normalize, safe_divide
from shapeenh.types import Camera, GBuffer

LARGEST = 1e9  # radius; and its inverse the smallest
LEAST_PIXELS = 0.75  # of radius, at least: above half a pixel's diagonal, so that no disc falls between pixel centres
NO_CENTRE = 1e6  # px; size of a disc whose centre is behind the eye: it takes part in means alone, not in slopes
RIDGE = 0.005  # of the linear fit, in squared radii


def gbuffer_from_points(
    points,
    normals,
    radius,
    camera: Camera,
    *,
    height: int,
    width: int,
    colors=None,
    cull: bool | str = False,
    tolerance: float | jax.Array = 1.0,
) -> GBuffer:
    """The G-buffer of a point cloud: every point a disc, the front ones blended into one smooth surface.

    A z-buffer finds the disc in front at each pixel. All discs that lie within `tolerance` radii behind it, and whose
    normal is within 60 degrees of its normal, then count with a weight that falls from the centre to the rim; normals
    are fitted by a linear function of the pixel (moving least squares), so that curvature does not see the single
    discs. Depth and colours are weighted means. Discs smaller than a pixel are enlarged to 0.75 px.

    Args:
        points: [N, 3], world units.
        normals: [N, 3], world space, any length > 0, either side: what is seen from behind is turned round, as for
            meshes. None: `estimate_normals`.
        radius: a number or [N], world units, in [1e-9, 1e9]. About twice the distance between neighbouring points
            gives smooth normals without holes. None: `estimate_radius`.
        camera: perspective, off-centre or orthographic.
        height, width: pixels, 1 to 32768.
        colors: [N, 3], linear RGB in [0, 1], or None.
        cull: False draws both sides; True or "back" drops discs seen from behind, "front" the others.
        tolerance: [], in [0.01, 100], radii of the front disc.

    Static: height, width, and which arguments are None.
    Returns: a GBuffer; everything 0 off the mask.
    Gradient: exact with respect to points, normals, radius, colors, tolerance and both camera matrices; the mask, the
        choice of the front disc and which discs are enlarged or turned round are constants.
    Errors: ValueError for shapes or numbers that are not accepted, zero normals, and None under jit (what is missing
        cannot be estimated there).

    >>> gbuffer = se.gbuffer_from_points(points, None, None, camera, height=600, width=800)
    """
    check_type("camera", camera, Camera)
    check_camera(camera)
    height, width = check_size("height", height), check_size("width", width)
    if not isinstance(cull, bool | str) or cull not in CULL:
        raise ValueError(f"cull is {cull!r}; accepted are False, True, 'none', 'back', 'front'")
    check_range("tolerance", tolerance, 0.01, 100)
    check_shape("points", points, (None, 3))
    check_finite("points", points)
    count = np.shape(points)[0]
    if normals is None:
        normals = estimate_normals(points, camera=camera) if count else np.zeros((0, 3), np.float32)
    if radius is None:
        radius = estimate_radius(points) if count else 1.0
    check_shape("normals", normals, (count, 3))
    check_finite("normals", normals)
    if np.shape(radius) not in ((), (count,)):
        raise ValueError(f"radius has shape {np.shape(radius)}; accepted is a number or [{count}]")
    check_range("radius", radius, 1 / LARGEST, LARGEST)
    if colors is not None:
        check_shape("colors", colors, (count, 3))
        check_finite("colors", colors)
    dtype = float_dtype(points, normals, radius, camera.view, camera.projection)
    cast = partial(jnp.asarray, dtype=dtype)
    points, normals, view, projection = cast(points), cast(normals), cast(camera.view), cast(camera.projection)
    if is_concrete(normals):
        zero = int(jnp.sum(jnp.all(normals == 0, axis=1)))
        if zero:
            raise ValueError(f"normals holds {zero} zero vector(s); accepted are directions of any length > 0")
    colors = None if colors is None else cast(colors)
    radius = jnp.broadcast_to(cast(radius), (count,))
    side = cast({"none": 0, "back": 1, "front": -1}[CULL[cull]])
    return _splatted(
        points, normals, radius, colors, view, projection, cast(tolerance), side, height=height, width=width
    )


@partial(jax.jit, static_argnames=("height", "width"))
def _splatted(points, normals, radius, colors, view, projection, tolerance, side, *, height, width) -> GBuffer:
    window = window_rows(projection, height, width)
    discs, seen = project_discs(points, normals, radius, colors, view, projection, window, tolerance, side)
    boxes = pixel_boxes(lax.stop_gradient(discs), seen, height, width)
    near = lax.stop_gradient(near_depth(projection))
    index = visible_discs(discs, boxes, near, height, width)
    mask = index >= 0
    if points.shape[0] == 0:
        zero = jnp.zeros((height, width, 3), points.dtype)
        return GBuffer(mask, zero[..., 0], zero, zero, None if colors is None else zero)

    index = jnp.where(mask, index, 0)
    front = front_surface(discs, index) * mask[..., None]
    tiles = to_tiles(front)
    boxes = without_hidden(discs, boxes, tiles, (height, width))
    sums = from_tiles(disc_sums(discs, tiles, near, boxes, (height, width)), height, width)
    depth, normal, color = blend(sums)
    # Where code that rounds differently has missed even the front disc the second time, that disc stands alone.
    alone = mask & (sums[..., 0] == 0)
    depth = jnp.where(alone, front[..., 0], depth)
    normal = jnp.where(alone[..., None], front[..., 1:4], normal)
    color = jnp.where(alone[..., None], discs[:, COLOR:][index], color)
    depth = jnp.where(mask, depth, 0)
    normal = facing(jnp.where(mask[..., None], normal, jnp.asarray([0, 0, 1], normal.dtype)))
    position = unproject(projection, window, depth, height, width)
    keep = lambda image: jnp.where(mask[..., None], image, 0)  # noqa: E731
    return GBuffer(mask, depth, keep(normal), keep(position), None if colors is None else keep(color))


# ------------------------------------------------------------------------------------------- from points to discs


def window_rows(projection, height, width):
    """Rows [3, 4] from camera space to homogeneous window coordinates X, Y, W in pixels, y down."""
    x, y, w = projection[0], projection[1], projection[3]
    return jnp.stack([0.5 * width * (w + x), 0.5 * height * (w - y), w])


def near_depth(projection):
    """Depth of the near plane, where z + w = 0."""
    row = projection[2] + projection[3]
    return safe_divide(row[3], row[2])


def project_discs(points, normals, radius, colors, view, projection, window, tolerance, side):
    """(discs [N, columns] as `splat` has them, whether each is drawn [N]); side: 1 draws those that face the viewer, -1
    the others, 0 both."""
    dot = partial(jnp.einsum, "nc,kc->nk", precision=lax.Precision.HIGHEST)
    centre = dot(points, view[:3, :3]) + view[None, :3, 3]
    n = normalize(dot(normals, view[:3, :3]))
    parallel = jnp.all(projection[3, :3] == 0)
    towards = jnp.where(parallel, n[:, 2], -jnp.sum(n * centre, axis=1))
    n = jnp.where(lax.stop_gradient(towards < 0)[:, None], -n, n)
    seen = jnp.where(side == 0, towards != 0, towards * side > 0)
    seen &= jnp.any(n != 0, axis=1) & jnp.all(jnp.isfinite(centre), axis=1)

    # Pixels per world unit at the centre: at least LEAST_PIXELS of radius.
    at = dot(centre, window[:, :3]) + window[None, :, 3]
    before = at[:, 2] > 0  # the eye
    w = jnp.where(before, at[:, 2], 1)
    scale = jnp.sqrt(jnp.abs(window[0, 0] * window[1, 1] - window[0, 1] * window[1, 0])) / w
    radius = jnp.where(before, jnp.maximum(radius, LEAST_PIXELS / scale), radius)

    u, v = tangents(n)
    axes = radius[:, None, None] * jnp.stack([u, v], axis=1)
    affine = jnp.einsum("nac,kc->nka", axes, window[:, :3], precision=lax.Precision.HIGHEST)
    affine = jnp.concatenate([affine, at[..., None]], axis=2)  # [N, (X, Y, W), (a, b, 1)]
    # Homogeneous: divided by the size of W, so that products stay of the order of pixels squared in any world unit.
    size = jnp.maximum(jnp.sum(jnp.abs(affine[:, 2]), axis=1), jnp.finfo(points.dtype).tiny * 1e6)
    affine = affine / lax.stop_gradient(size)[:, None, None]
    depth = jnp.concatenate([-axes[..., 2], -centre[:, 2:]], axis=1)
    columns = [
        affine.reshape(-1, 9),
        depth,
        jnp.where(before[:, None], at[:, :2] / w[:, None], 0),
        n,
        jnp.where(before, radius * scale, NO_CENTRE)[:, None],
        (tolerance * radius)[:, None],
    ]
    return jnp.concatenate(columns if colors is None else [*columns, colors], axis=1), seen


def tangents(n):
    """Two unit vectors that span a right-handed frame with n; without a branch (Duff et al. 2017)."""
    x, y, z = n[:, 0], n[:, 1], n[:, 2]
    sign = jnp.where(z < 0, -1, 1).astype(n.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    u = jnp.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    return u, jnp.stack([b, sign + y * y * a, -y], axis=1)


def pixel_boxes(discs, seen, height, width):
    """Tiles that each disc may touch, from the exact bounds of its ellipse; all for one that the eye plane cuts.

    With X - x W = 0 touching the unit circle: (X0 - x W0)^2 + (X1 - x W1)^2 = (X2 - x W2)^2, solved for x about the
    centre, where nothing cancels.
    """
    w = [discs[:, 6 + k] for k in range(3)]
    power = w[2] * w[2] - w[0] * w[0] - w[1] * w[1]
    whole = (power <= 1e-6 * w[2] * w[2]) | (w[2] <= 0)
    behind = whole & (jnp.hypot(w[0], w[1]) + w[2] <= 0)
    power = jnp.where(whole, 1, power)
    boxes = []
    for axis, count in ((0, width), (1, height)):
        centre = discs[:, 3 * axis + 2] / jnp.where(whole, 1, w[2])
        p, q = (discs[:, 3 * axis + k] - centre * w[k] for k in range(2))
        middle = -(p * w[0] + q * w[1]) / power
        half = jnp.sqrt(jnp.maximum(middle * middle + (p * p + q * q) / power, 0)) + 0.01
        low = jnp.ceil(jnp.clip(centre + middle - half, -1, count + 1) - 0.5)
        high = jnp.floor(jnp.clip(centre + middle + half, -1, count + 1) - 0.5)
        low, high = jnp.where(whole, 0, low), jnp.where(whole, count - 1, high)
        empty = behind | ~seen | ~jnp.isfinite(low + high)
        low, high = jnp.where(empty, 0, low).astype(jnp.int32), jnp.where(empty, -1, high).astype(jnp.int32)
        boxes += [jnp.maximum(low, 0), jnp.minimum(high, count - 1)]
    return tile_boxes(*boxes)


# ------------------------------------------------------------------------------------------- from discs to pixels


def front_surface(discs, index):
    """Depth, normal and tolerance of the front disc of each pixel, [H, W, FRONT]."""
    height, width = index.shape
    columns = discs[:, : REACH + 1].at[index.reshape(-1)].get(mode="promise_in_bounds")
    x = jnp.broadcast_to((jnp.arange(width, dtype=discs.dtype) + 0.5)[None], (height, width)).reshape(-1, 1)
    y = jnp.broadcast_to((jnp.arange(height, dtype=discs.dtype) + 0.5)[:, None], (height, width)).reshape(-1, 1)
    a, b, _ = meet(columns, x, y, slack=SLACK)
    front = jnp.concatenate(
        [depth_at(columns, a, b), columns[:, NORMAL : NORMAL + 3], columns[:, REACH : REACH + 1]], axis=1
    )
    return front.reshape(height, width, -1)


def blend(sums):
    """(depth [H, W], normal [H, W, 3] not unit, colours [H, W, C]) from `disc_sums` [H, W, channels].

    n(s) = n0 + G s is fitted to the discs' normals at their centres s, counted from the pixel, and read at s = 0:
    n0 = mean n - G mean s, G = cov(n, s) (cov(s, s) + ridge)^-1. The ridge, a fraction of the squared radius, keeps the
    fit from extrapolating where the discs lie on a line or all on one side: there it becomes the mean.
    """
    mean = safe_divide(sums[..., 1:], sums[..., :1])
    cx, cy, xx, xy, yy, size = (mean[..., k : k + 1] for k in range(6))
    n, nx, ny = mean[..., 6:9], mean[..., 9:12], mean[..., 12:15]
    colors, depth = mean[..., 15:-1], mean[..., -1]
    height, width = depth.shape
    ox, oy = pixel_offsets(height, width, depth.dtype)  # centres were counted from the middle of the tile
    sx, sy = cx - ox, cy - oy
    nx, ny = nx - n * cx, ny - n * cy
    ridge = RIDGE * size + jnp.finfo(sums.dtype).tiny * 1e6
    xx, xy, yy = xx - cx * cx + ridge, xy - cx * cy, yy - cy * cy + ridge
    tx, ty = yy * sx - xy * sy, xx * sy - xy * sx
    return depth, n - safe_divide(nx * tx + ny * ty, xx * yy - xy * xy), colors


def unproject(projection, window, depth, height, width):
    """Camera-space positions [H, W, 3] of the pixel centres at a depth."""
    x = (jnp.arange(width, dtype=depth.dtype) + 0.5)[None, :, None]
    y = (jnp.arange(height, dtype=depth.dtype) + 0.5)[:, None, None]
    shape = (height, width, 4)
    k = jnp.broadcast_to(window[0][None, None] - x * window[2][None, None], shape)
    m = jnp.broadcast_to(window[1][None, None] - y * window[2][None, None], shape)
    z = -depth
    e, f = k[..., 2] * z + k[..., 3], m[..., 2] * z + m[..., 3]
    det = k[..., 0] * m[..., 1] - k[..., 1] * m[..., 0]
    return jnp.stack([(k[..., 1] * f - m[..., 1] * e) / det, (m[..., 0] * e - k[..., 0] * f) / det, z], axis=-1)
