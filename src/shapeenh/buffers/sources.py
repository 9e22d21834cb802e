"""G-buffers from images: normals (RGBN, RTI) and height fields, seen straight from above (SPEC 2).

Both views are orthographic, pixel centres `spacing` world units apart: the pixel in row r and column c lies at
x = (c + 1/2 - W/2) dx, y = (H/2 - r - 1/2) dy, z = -depth.
"""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh.buffers.normals import decoded, facing, turn_green, warn_of_convention
from shapeenh.checks import check_range, check_shape, float_dtype
from shapeenh.stencils import shift
from shapeenh.types import GBuffer

LARGEST = 1e9  # of heights, of factors, and of their inverses: products and derivatives stay within float32

# ------------------------------------------------------------------------------------------- normals


def gbuffer_from_normals(
    normal,
    *,
    depth=None,
    mask=None,
    occlusion=None,
    albedo=None,
    spacing=1.0,
    green: str = "up",
    check: bool = True,
) -> GBuffer:
    """The G-buffer of an image of normals: RGBN pictures, photometric stereo, RTI (SPEC 2).

    Pixels whose normal is zero or not finite are off the mask, and so are those whose depth is not finite or not
    positive. Without a depth image `depth` is 1 everywhere on the mask: a constant depth has no steps, so that
    silhouettes come from the occlusion map, if there is one.

    Args:
        normal: [H, W, 3] floats, any length > 0, x right, y up, z towards the viewer; n_z is held above 0.01. Or uint8
            or uint16, as `decode_normals` takes them (with alpha too).
        depth: [H, W], distance along the view axis, world units, in ]0, 1e18]; or None.
        mask: [H, W], nonzero where there is a surface; or None: wherever there is a normal.
        occlusion: [H, W], 1 = open, 0 = occluded, floats, or unsigned integers up to their maximum; or None.
        albedo: [H, W, 3], linear RGB in [0, 1]; or None.
        spacing: world units per pixel, a number or (dx, dy), in [1e-9, 1e9].
        green: "up" (OpenGL) or "down" (DirectX): which way the second component points.
        check: warn where the normals contradict the convention; costs a few milliseconds per megapixel.

    Static: which arguments are None, green, check.
    Gradient: with respect to normal, depth, occlusion, albedo, spacing.
    Errors: ValueError for shapes, types or numbers that are not accepted.

    >>> gbuffer = se.gbuffer_from_normals(se.load_image("coin_normals.png"), occlusion=occlusion)
    """
    image = normal if isinstance(normal, jax.Array) else np.asarray(normal)
    if image.dtype.kind == "u":
        normal = decoded(image, green, stacklevel=3)
    else:
        check_shape("normal", image, (None, None, 3))
        if not jnp.issubdtype(image.dtype, jnp.floating):
            raise ValueError(f"normal has dtype {image.dtype}; accepted are floats, uint8 and uint16")
        normal = turn_green(jnp.asarray(image, float_dtype(image)), green)
    height, width = normal.shape[:2]
    if height == 0 or width == 0:
        raise ValueError(f"normal has shape {normal.shape}; accepted are images of at least one pixel")
    dtype = normal.dtype
    shape = (height, width)
    mask = _mask(mask, shape)
    depth = None if depth is None else _floats("depth", depth, shape, dtype)
    occlusion, albedo = _occlusion(occlusion, shape, dtype), _albedo(albedo, shape, dtype)
    if check:
        seen = jnp.ones(shape, bool) if mask is None else mask
        warn_of_convention(normal, seen, green, "normal", stacklevel=3)
    return _from_normals(normal, depth, mask, occlusion, albedo, _spacing(spacing, dtype))


@jax.jit
def _from_normals(normal, depth, mask, occlusion, albedo, spacing) -> GBuffer:
    good = jnp.all(jnp.isfinite(normal), axis=-1) & jnp.any(normal != 0, axis=-1)
    if mask is not None:
        good &= mask
    if depth is not None:
        good &= (depth > 0) & (depth <= LARGEST * LARGEST)
    n = jnp.where(good[..., None], normal, jnp.asarray([0, 0, 1], normal.dtype))
    n = jnp.where(good[..., None], facing(n), 0)
    d = jnp.where(good, jnp.ones((), normal.dtype) if depth is None else depth, 0)
    return _gbuffer(good, d, n, occlusion, albedo, spacing)


# ------------------------------------------------------------------------------------------- heights


def gbuffer_from_height(
    height,
    *,
    spacing=1.0,
    z_factor=1.0,
    nodata: float | None = None,
    max_slope: float | None = None,
    mask=None,
    occlusion=None,
    albedo=None,
) -> GBuffer:
    """The G-buffer of a height field seen from above: elevation models, relief scans, depth sensors (SPEC 2).

    Normals are those of the sampled surface, by derivatives of second order that never read across a hole and become
    one-sided at holes and at the border, so that no pixel is lost there. Only differences of heights count: the highest
    point lies one pixel below the plane that depth is measured from. Heights in NumPy's float64 or integers lose
    nothing by a large offset.

    Args:
        height: [H, W], towards the viewer; NaN, infinite, or beyond ±1e9 where there is none. Of a depth map: -depth.
        spacing: world units per pixel, a number or (dx, dy), in [1e-9, 1e9].
        z_factor: world units per unit of height, in [1e-9, 1e9]; larger exaggerates the relief.
        nodata: a number that stands for "no height", beside NaN; or None.
        max_slope: where two neighbours are further apart than this slope the surface is torn (cliffs, objects before a
            background): no derivative is taken across, and the descriptor finds a silhouette there. None: nowhere.
        mask: [H, W], nonzero where the heights count; or None.
        occlusion, albedo: as in `gbuffer_from_normals`.

    Static: which arguments are None.
    Gradient: with respect to height, spacing, z_factor, occlusion, albedo; none through the plane that depth is
        measured from, nor through the choice of where the surface is torn.
    Errors: ValueError for shapes, types or numbers that are not accepted. Warns for 8 bits.

    >>> gbuffer = se.gbuffer_from_height(dem, spacing=30.0, z_factor=2.0, nodata=-9999)
    """
    check_shape("height", height, (None, None))
    shape = tuple(np.shape(height))
    if 0 in shape:
        raise ValueError(f"height has shape {shape}; accepted are images of at least one pixel")
    check_range("z_factor", z_factor, 1 / LARGEST, LARGEST)
    if max_slope is not None:
        check_range("max_slope", max_slope, 0, np.inf, open_ends=True)
    height, good = _heights(height, nodata)
    dtype = height.dtype
    mask = _mask(mask, shape)
    good = good if mask is None else good & mask
    occlusion, albedo = _occlusion(occlusion, shape, dtype), _albedo(albedo, shape, dtype)
    steepest = None if max_slope is None else jnp.asarray(max_slope, dtype)
    z_factor = jnp.asarray(z_factor, dtype)
    return _from_height(height, good, occlusion, albedo, _spacing(spacing, dtype), z_factor, steepest)


def _heights(height, nodata):
    """(heights as floats, where there are any [H, W] bool)."""
    if isinstance(height, jax.Array):
        if not jnp.issubdtype(height.dtype, jnp.floating):
            height = height.astype(float_dtype(height))
        good = jnp.abs(height) <= LARGEST
        return height, good if nodata is None else good & (height != jnp.asarray(nodata, height.dtype))
    height = np.asarray(height)
    if height.dtype.kind not in "biuf":
        raise ValueError(f"height has dtype {height.dtype}; accepted are real numbers")
    if height.dtype == np.uint8:
        warnings.warn(
            "8-bit heights are 256 levels, which show in curvature: use a sigma of 2 px or more (on waves of "
            "64 px its error is then 2 %, at sigma 0 it is 27 %), or 16 bits",
            stacklevel=3,
        )
    wide = height.astype(np.float64)
    good = np.abs(wide) <= LARGEST
    if nodata is not None:
        # The value is written as text beside the pixels: compare what it becomes in their type.
        with np.errstate(over="ignore"):
            same = height.dtype.type(nodata) if height.dtype.kind == "f" else nodata
        good &= height != same
    # What float32 would round away in an elevation of kilometres is the relief: take the offset off first.
    base = wide[good].min() if good.any() else 0.0
    return jnp.asarray(np.where(good, wide - base, 0), float_dtype(height)), jnp.asarray(good)


@jax.jit
def _from_height(height, good, occlusion, albedo, spacing, z_factor, max_slope) -> GBuffer:
    dx, dy = spacing[0], spacing[1]
    z = jnp.where(good, height, 0) * z_factor
    link_x, link_y = good[:, :-1] & good[:, 1:], good[:-1] & good[1:]
    if max_slope is not None:
        link_x &= jnp.abs(z[:, 1:] - z[:, :-1]) <= max_slope * dx
        link_y &= jnp.abs(z[1:] - z[:-1]) <= max_slope * dy
    zx, zy = _difference(z, link_x, 1) / dx, -_difference(z, link_y, 0) / dy
    n = facing(jnp.stack([-zx, -zy, jnp.ones_like(z)], axis=-1))
    n = jnp.where(good[..., None], n, 0)
    top = jax.lax.stop_gradient(jnp.max(jnp.where(good, z, -jnp.inf)))
    d = jnp.where(good, jnp.where(jnp.isfinite(top), top, 0) - z + jnp.maximum(dx, dy), 0)
    return _gbuffer(good, d, n, occlusion, albedo, spacing)


def _difference(z, link, axis: int):
    """Derivative per pixel towards growing index; `link` says which neighbours may be read.

    Central where both may, (-3, 4, -1)/2 where one side is missing, a plain difference where the other side has but one
    pixel, 0 where there is none: second order everywhere but in the last two cases.
    """
    ahead1 = jnp.pad(link, [(0, 1) if k == axis else (0, 0) for k in (0, 1)])
    ahead2, behind1, behind2 = (shift(ahead1, k, axis) for k in (1, -1, -2))
    step = shift(z, 1, axis) - z
    after, before, earlier = (shift(step, k, axis) for k in (1, -1, -2))
    one_sided = jnp.where(ahead1, step + 0.5 * jnp.where(ahead2, step - after, 0), 0)
    one_sided = jnp.where(behind1, before + 0.5 * jnp.where(behind2, before - earlier, 0), one_sided)
    return jnp.where(ahead1 & behind1, 0.5 * (step + before), one_sided)


# ------------------------------------------------------------------------------------------- what both share


def _gbuffer(good, depth, normal, occlusion, albedo, spacing) -> GBuffer:
    """The record of an orthographic view; fields 0 off the mask, occlusion 1."""
    height, width = depth.shape
    x = (jnp.arange(width, dtype=depth.dtype) + (0.5 - 0.5 * width)) * spacing[0]
    y = (0.5 * height - 0.5 - jnp.arange(height, dtype=depth.dtype)) * spacing[1]
    shape = (height, width)
    position = jnp.stack([jnp.broadcast_to(x[None], shape), jnp.broadcast_to(y[:, None], shape), -depth], axis=-1)
    if occlusion is not None:
        occlusion = jnp.where(good & jnp.isfinite(occlusion), jnp.clip(occlusion, 0, 1), 1)
    if albedo is not None:
        albedo = jnp.where(good[..., None] & jnp.isfinite(albedo), albedo, 0)
    return GBuffer(
        mask=good,
        depth=depth,
        normal=normal,
        position=jnp.where(good[..., None], position, 0),
        albedo=albedo,
        occlusion=occlusion,
    )


def _spacing(spacing, dtype):
    """(dx, dy) as an array, so that other values do not recompile."""
    check_range("spacing", spacing, 1 / LARGEST, LARGEST)
    shape = np.shape(spacing)
    if shape not in ((), (2,)):
        raise ValueError(f"spacing has shape {shape}; accepted is a number or (dx, dy)")
    return jnp.broadcast_to(jnp.asarray(spacing, dtype), (2,))


def _mask(mask, shape):
    if mask is None:
        return None
    check_shape("mask", mask, shape)
    return jnp.asarray(mask) != 0


def _floats(name: str, image, shape, dtype):
    """A float image of a fixed shape; integers would be in units that nobody has said."""
    check_shape(name, image, shape)
    image = image if isinstance(image, jax.Array) else np.asarray(image)
    if not jnp.issubdtype(image.dtype, jnp.floating):
        raise ValueError(f"{name} has dtype {image.dtype}; accepted are floats")
    return jnp.asarray(image, dtype)


def _occlusion(occlusion, shape, dtype):
    if occlusion is None:
        return None
    image = occlusion if isinstance(occlusion, jax.Array) else np.asarray(occlusion)
    if image.dtype.kind == "u":
        image = jnp.asarray(image, dtype) / np.iinfo(image.dtype).max
    return _floats("occlusion", image, shape, dtype)


def _albedo(albedo, shape, dtype):
    return None if albedo is None else _floats("albedo", albedo, (*shape, 3), dtype)
