"""Blocks: the image as 8 x 8 pixels, and the list of those that hold a surface.

Shading walks that list in groups, so that background costs nothing, a group's temporaries stay in cache, and the
number of steps depends on the picture alone. Squares rather than runs of a row, because the normals in a square are
alike: most lights that a block cannot see are found from the box of its normals. A group is laid out (block, channel,
64 pixels): XLA splits the first axis over the cores and vectorises the last.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax

SIDE = 8
PIXELS = SIDE * SIDE


def padded(image):
    """An image [H, W, ...] with height and width rounded up to whole blocks; a copy only where they are not."""
    rows, columns = -image.shape[0] % SIDE, -image.shape[1] % SIDE
    if not rows and not columns:
        return image
    return jnp.pad(image, [(0, rows), (0, columns)] + [(0, 0)] * (image.ndim - 2))


def covered(mask):
    """Which blocks have a pixel on the padded mask [H, W]; in two steps, so that the first one vectorises."""
    rows = jnp.any(mask.reshape(-1, SIDE, mask.shape[1]), axis=1)
    return jnp.any(rows.reshape(-1, SIDE), axis=1)


def listed(key, covered, group: int):
    """(ids [blocks + group], total): the covered blocks by ascending key, padded by repeating the last, and their
    number.

    Neighbours in the list do the same number of steps, so a group wastes few. Key and number share one integer: a
    sort without payload is several times faster.
    """
    count = covered.shape[0]
    shift = max(1, (count - 1).bit_length())
    number = lax.iota(jnp.int32, count)
    top = (1 << (31 - shift)) - 1
    word = (jnp.minimum(key, top - 1) << shift) | number
    word = jnp.sort(jnp.where(covered, word, (top << shift) | number))
    total = jnp.sum(covered, dtype=jnp.int32)
    ids = word & ((1 << shift) - 1)
    last = ids[jnp.maximum(total - 1, 0)]
    ids = jnp.where(lax.iota(jnp.int32, count) < total, ids, last)
    return jnp.concatenate([ids, jnp.broadcast_to(last, (group,))]), total


def _corner(ids, width: int):
    across = width // SIDE
    row = ids // across
    return jnp.stack([row * SIDE, (ids - row * across) * SIDE], axis=-1)


def read(image, ids):
    """Blocks of an image [H, W, C] (or [H, W]) as [blocks, C, 64]."""
    image = image[..., None] if image.ndim == 2 else image
    channels = image.shape[2]
    numbers = lax.GatherDimensionNumbers(offset_dims=(1, 2, 3), collapsed_slice_dims=(), start_index_map=(0, 1))
    mode = lax.GatherScatterMode.PROMISE_IN_BOUNDS
    found = lax.gather(image, _corner(ids, image.shape[1]), numbers, (SIDE, SIDE, channels), mode=mode)
    return jnp.moveaxis(found.reshape(-1, PIXELS, channels), 2, 1)


def write(image, ids, values):
    """`image` [H, W, C] with the blocks `values` [blocks, C, 64] written; one that is named twice has one value, one
    beyond the image (`beyond`) is dropped."""
    values = jnp.moveaxis(values, 1, 2).reshape(-1, SIDE, SIDE, image.shape[2])
    numbers = lax.ScatterDimensionNumbers(
        update_window_dims=(1, 2, 3), inserted_window_dims=(), scatter_dims_to_operand_dims=(0, 1)
    )
    mode = lax.GatherScatterMode.FILL_OR_DROP
    return lax.scatter(image, _corner(ids, image.shape[1]), values, numbers, mode=mode)


def beyond(image) -> int:
    """The number of a block that the image does not have."""
    return image.shape[0] * image.shape[1] // PIXELS


def least(values):
    """Minimum over the last axis of 64; in two steps, so that the first one vectorises."""
    return jnp.min(jnp.min(values.reshape(*values.shape[:-1], SIDE, SIDE), axis=-2), axis=-1)


def sum_pixels(values):
    """Sum over the last axis of 64; in two steps, so that the first one vectorises."""
    return jnp.sum(jnp.sum(values.reshape(*values.shape[:-1], SIDE, SIDE), axis=-2), axis=-1)
