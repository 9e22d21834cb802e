"""Textures: bilinear sampling at texture coordinates, and colours from them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from shapeenh.checks import check_choice, check_shape, check_type, float_dtype
from shapeenh.types import GBuffer, replace

WRAP = ("repeat", "clamp")


def sample_texture(texture, uv, *, wrap: str = "repeat") -> jax.Array:
    """A texture at texture coordinates, bilinear between the centres of its texels.

    (u, v) = (0, 0) is the lower left corner of the image, (1, 1) the upper right one; row 0 is at the top. There is no
    prefilter: a texture much finer than the pixels aliases.

    Args:
        texture: [h, w, C] floats.
        uv: [..., 2]; where it is not finite it counts as (0, 0).
        wrap: "repeat", or "clamp" to the outermost texels.

    Static: wrap.
    Returns: [..., C].
    Gradient: with respect to texture and uv: that of the bilinear patch, one-sided between two patches; 0 along an
        axis that is clamped.
    Errors: ValueError for other shapes, an integer or empty texture, or another `wrap`.

    >>> color = se.sample_texture(texture, gbuffer.uv)
    """
    check_choice("wrap", wrap, WRAP)
    check_texture("texture", texture)
    check_shape("uv", uv, (..., 2))
    dtype = float_dtype(texture, uv)
    return bilinear(jnp.asarray(texture, dtype), jnp.asarray(uv, dtype), wrap=wrap)


def check_texture(name: str, texture) -> None:
    check_shape(name, texture, (None, None, None))
    dtype = texture.dtype if isinstance(texture, jax.Array) else np.asarray(texture).dtype
    if not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(f"{name} has dtype {dtype}; accepted are floats (load_image(path, linear=True) gives them)")
    if 0 in np.shape(texture):
        raise ValueError(f"{name} has shape {np.shape(texture)}; accepted are textures of at least one texel")


def bilinear(texture, uv, *, wrap: str):
    """`sample_texture` of checked arrays."""
    h, w, _ = texture.shape
    uv = jnp.where(jnp.isfinite(uv), uv, 0)
    uv = uv - jnp.floor(uv) if wrap == "repeat" else jnp.clip(uv, 0, 1)
    x, y = uv[..., 0] * w - 0.5, (1 - uv[..., 1]) * h - 0.5
    x0, y0 = jnp.floor(x), jnp.floor(y)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    hold = (lambda i, n: i % n) if wrap == "repeat" else (lambda i, n: jnp.clip(i, 0, n - 1))
    column, row = x0.astype(jnp.int32), y0.astype(jnp.int32)
    flat = texture.reshape(h * w, -1)

    def texel(i, j):
        return flat.at[hold(row + i, h) * w + hold(column + j, w)].get(mode="promise_in_bounds")

    upper = texel(0, 0) * (1 - fx) + texel(0, 1) * fx
    lower = texel(1, 0) * (1 - fx) + texel(1, 1) * fx
    return upper * (1 - fy) + lower * fy


def apply_texture(gbuffer: GBuffer, texture, *, wrap: str = "repeat") -> GBuffer:
    """The G-buffer with a texture as its albedo.

    Args:
        gbuffer: with `uv`, as `render_gbuffer(..., uv=True)` makes it.
        texture: [h, w, 3] floats, linear RGB in [0, 1].
        wrap: as in `sample_texture`.

    Static: wrap.
    Returns: a GBuffer whose albedo is the texture on the mask and 0 off it; other fields are the same.
    Gradient: with respect to texture and uv.
    Errors: ValueError without uv, and as in `sample_texture`.

    >>> gbuffer = se.apply_texture(se.render_gbuffer(mesh, camera, height=600, width=800, uv=True), texture)
    """
    check_type("gbuffer", gbuffer, GBuffer)
    if gbuffer.uv is None:
        raise ValueError(
            "gbuffer.uv is None; accepted are G-buffers with texture coordinates: render_gbuffer(..., uv=True)"
        )
    check_shape("texture", texture, (None, None, 3))
    color = sample_texture(texture, gbuffer.uv, wrap=wrap)
    return replace(gbuffer, albedo=jnp.where(gbuffer.mask[..., None], color, 0))
