"""Discs through a z-buffer: which disc each pixel sees, and sums over all discs near the front one (SPEC 2).

A disc is c + a u + b v, a^2 + b^2 <= 1. Times the matrices of a camera it becomes homogeneous window coordinates X, Y,
W, each affine in (a, b): three numbers. The viewing ray of a pixel (x, y) meets the disc's plane where
(X - x W) . (a, b, 1) = 0 and (Y - y W) . (a, b, 1) = 0, hence at the cross product of those two triples (Weyrich et
al. 2007, "A Hardware Architecture for Surface Splatting"): exact under perspective and orthographic cameras alike.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from shapeenh.buffers.pairs import LANES, TILE_H, TILE_W, from_tiles, lanes, tiling, walk
from shapeenh.buffers.xla import take
from shapeenh.fusion import stored
from shapeenh.numerics import smoothstep

GEOMETRY = 12  # columns of a disc: X, Y, W, depth, three each
CENTRE, NORMAL, SIZE, REACH, COLOR = 12, 14, 17, 18, 19  # window coordinates; unit; radius in px; tolerance; colour
FRONT = 5  # planes of the front surface: depth, normal, tolerance
SLACK = 1e-3
EDGE_WEIGHT = 1e-3  # of a disc at its rim: a pixel that sees one rim alone still has a weight

# ------------------------------------------------------------------------------------------- rays and discs


def meet(disc, x, y, *, slack: float = 0.0):
    """(a, b, whether a ray through the pixel centre x, y meets the disc in front of the eye), planes [n, lanes].

    disc: [n, columns]; x, y: [n, lanes]. a and b are 0 where it does not. With `slack` the disc is that much larger:
    what was hit at the very rim is hit again, though other compiled code rounds differently.
    """
    col = lambda k: disc[:, k : k + 1]  # noqa: E731
    k = [col(i) - x * col(6 + i) for i in range(3)]
    m = [col(3 + i) - y * col(6 + i) for i in range(3)]
    qa, qb, q = k[1] * m[2] - k[2] * m[1], k[2] * m[0] - k[0] * m[2], k[0] * m[1] - k[1] * m[0]
    square = q * q  # 0 also where q underflows: such a disc is seen edge-on
    hit = (qa * qa + qb * qb <= (1 + slack) * square) & (square >= jnp.finfo(disc.dtype).tiny)
    q = jnp.where(hit, q, 1)
    a, b = jnp.where(hit, qa / q, 0), jnp.where(hit, qb / q, 0)
    hit &= col(6) * a + col(7) * b + col(8) > 0
    return a, b, hit


def depth_at(disc, a, b):
    return disc[:, 9:10] * a + disc[:, 10:11] * b + disc[:, 11:12]


# ------------------------------------------------------------------------------------------- visibility


def visible_discs(discs, boxes, near, height: int, width: int):
    """Index of the disc in front at each pixel centre, [H, W] int32, -1 for none; ties go to the lowest. No gradient.

    As for triangles, a key holds the nearness above the complement of the index, and one integer maximum is the whole
    depth test. The nearness is a float32 made sortable as an integer.
    """

    @jax.custom_batching.sequential_vmap  # a batched loop would drag every view along until the last one is done
    def one_view(discs, boxes, near):
        rows, columns = tiling(height, width)
        # Under an orthographic camera far away, differences of depth are what counts.
        offset = jnp.min(discs[:, 11], initial=jnp.finfo(discs.dtype).max)
        with jax.enable_x64(True):
            keys = jnp.zeros((rows * columns, LANES), jnp.uint64)

            def draw(keys, disc, column, row, valid):
                x, y = lanes(column, row, discs.dtype)
                d = take(discs, disc)
                a, b, hit = meet(d, x, y)
                depth = depth_at(d, a, b)
                hit = hit & (depth >= near) & valid[:, None]
                new = pack(hit, offset - depth, ~lax.convert_element_type(disc, jnp.uint32)[:, None])
                return keys.at[row * columns + column].max(new, mode="promise_in_bounds")

            keys = walk(boxes, draw, keys)
            index = lax.bitcast_convert_type(~lax.convert_element_type(keys, jnp.uint32), jnp.int32)
            index = jnp.where(keys == 0, jnp.int32(-1), index)
        return from_tiles(index[:, None], height, width)[..., 0]

    if discs.shape[0] == 0:
        return jnp.full((height, width), -1, jnp.int32)
    return one_view(lax.stop_gradient(discs), boxes, lax.stop_gradient(near))


def without_hidden(discs, boxes, front, size):
    """The boxes, empty for discs that lie behind the front surface and its tolerance at every tile they touch: half of
    the work on a closed surface."""
    columns = tiling(*size)[1]

    @jax.custom_batching.sequential_vmap
    def one_view(discs, boxes, front):
        deepest = jnp.max(front[:, 0] + front[:, 4], axis=1)
        nearest = discs[:, 11] - jnp.hypot(discs[:, 9], discs[:, 10])

        def look(shown, disc, column, row, valid):
            before = take(nearest, disc) <= take(deepest, row * columns + column)
            return shown.at[disc].max(before & valid, mode="promise_in_bounds")

        shown = walk(boxes, look, jnp.zeros(discs.shape[0], bool))
        return jnp.where(shown[:, None], boxes, 0)

    return one_view(*lax.stop_gradient((discs, boxes, front)))


def pack(hit, nearness, low):
    """Keys uint64, 0 where there is no hit; floats of both signs in ascending order."""
    bits = lax.bitcast_convert_type(lax.convert_element_type(nearness, jnp.float32), jnp.uint32)
    bits = jnp.where(bits >> np.uint32(31) != 0, ~bits, bits | np.uint32(1 << 31))
    high = lax.convert_element_type(jnp.where(hit, bits, np.uint32(0)), jnp.uint64) << np.uint64(32)
    return high | lax.convert_element_type(jnp.where(hit, low, np.uint32(0)), jnp.uint64)


# ------------------------------------------------------------------------------------------- sums over discs
#
# What a disc adds to the sums at a pixel is a weight times constants of the disc: an outer product. `stored` keeps XLA
# from computing the weights again for every channel.


def weights(hit, a, b, depth, cosine, front_depth, tolerance):
    """(weight, weight times depth) of discs at pixels that they hit at (a, b), planes.

    The weight is (1 - rho^2)^2 over the disc, fades out where the disc lies deeper behind the front one than half the
    tolerance, and where its normal is more than 60 degrees off.
    """
    inner = jnp.maximum(1 - a * a - b * b, 0)
    near_front = 1 - smoothstep(0.5, 1.0, (depth - front_depth) / tolerance)
    w = jnp.where(hit, (inner * inner + EDGE_WEIGHT) * near_front * smoothstep(0.0, 0.5, cosine), 0)
    return w, w * depth


def arguments(disc, front, near, column, row, valid):
    """What `weights` takes, for the pixels of tiles."""
    a, b, hit = meet(disc, *lanes(column, row, disc.dtype), slack=SLACK)
    depth = depth_at(disc, a, b)
    hit &= valid[:, None] & (front[:, 4] > 0) & (depth >= near - 1e-6 * front[:, 0])  # what is in front is hit again
    cosine = sum(disc[:, NORMAL + k, None] * front[:, 1 + k] for k in range(3))
    return hit, a, b, depth, cosine, front[:, 0], jnp.where(hit, front[:, 4], 1)


def constants(disc, column, row):
    """What is weighted, [n, channels]: 1, the disc's centre from the tile's and its squares, its size squared, its
    normal and that times the centre: the moments of a linear fit; and its colour."""
    cx = disc[:, CENTRE] - ((column + 0.5) * TILE_W).astype(disc.dtype)
    cy = disc[:, CENTRE + 1] - ((row + 0.5) * TILE_H).astype(disc.dtype)
    n = disc[:, NORMAL : NORMAL + 3]
    single = [jnp.ones_like(cx), cx, cy, cx * cx, cx * cy, cy * cy, disc[:, SIZE] ** 2]
    groups = [jnp.stack(single, axis=1), n, n * cx[:, None], n * cy[:, None], disc[:, COLOR:]]
    return jnp.concatenate(groups, axis=1)


@partial(jax.custom_vjp, nondiff_argnums=(4,))
def disc_sums(discs, front, near, boxes, size):
    """Sums over all discs of weight times `constants`, and of weight times depth last, [tiles, channels, lanes], given
    the front surface [tiles, FRONT, lanes].

    Gradient: exact with respect to discs and front, by a second walk that computes the weights again: memory does not
    depend on the number of pairs.
    """
    columns = tiling(*size)[1]

    @jax.custom_batching.sequential_vmap
    def one_view(discs, front, near, boxes):
        def add(sums, disc, column, row, valid):
            tile = row * columns + column
            d = take(discs, disc)
            f = take(front, tile)
            w, w_depth = stored(disc[0] >= 0, lambda: weights(*arguments(d, f, near, column, row, valid)))
            new = jnp.concatenate([w[:, None] * constants(d, column, row)[:, :, None], w_depth[:, None]], axis=1)
            return sums.at[tile].add(new, mode="promise_in_bounds")

        channels = 17 + discs.shape[1] - COLOR
        return walk(boxes, add, jnp.zeros((front.shape[0], channels, LANES), discs.dtype))

    return one_view(discs, front, near, boxes)


def _sums_forward(discs, front, near, boxes, size):
    return disc_sums(discs, front, near, boxes, size), (discs, front, near, boxes)


def _sums_backward(size, saved, bar):
    columns = tiling(*size)[1]

    @jax.custom_batching.sequential_vmap
    def one_view(discs, front, near, boxes, bar):
        def back(state, disc, column, row, valid):
            discs_bar, front_bar = state
            tile = row * columns + column
            some = disc[0] >= 0
            d, f, above = take(discs, disc), take(front, tile), take(bar, tile)
            x, y = lanes(column, row, d.dtype)
            hit, *inputs = stored(some, lambda: arguments(d, f, near, column, row, valid))
            w, _ = stored(some, lambda: weights(hit, *inputs))
            c, pull_constants = jax.vjp(lambda d: constants(d, column, row), d)
            c_bar = jnp.einsum("ncl,nl->nc", above[:, :-1], w)
            w_bar = jnp.einsum("ncl,nc->nl", above[:, :-1], c), above[:, -1]
            a, b, *_ = inputs
            a_bar, b_bar, depth_bar, cosine_bar, nearest_bar, tolerance_bar = stored(
                some, lambda: jax.vjp(lambda *t: weights(hit, *t), *inputs)[1](w_bar)
            )
            planes = stored(some, lambda: meet_backward(d, x, y, a, b, a_bar, b_bar, depth_bar, hit))
            one = jnp.ones_like(a)
            geometry = jnp.einsum("nil,njl->nij", jnp.stack(planes, axis=1), jnp.stack([a, b, one], axis=1))
            n_bar = jnp.einsum("nl,nkl->nk", cosine_bar, f[:, 1:4])
            zero = jnp.zeros_like(d)
            d_bar = zero.at[:, :GEOMETRY].set(geometry.reshape(-1, GEOMETRY)).at[:, NORMAL : NORMAL + 3].set(n_bar)
            front_n_bar = cosine_bar[:, None] * d[:, NORMAL : NORMAL + 3, None]
            f_bar = jnp.concatenate([nearest_bar[:, None], front_n_bar, tolerance_bar[:, None]], axis=1)
            discs_bar = discs_bar.at[disc].add(d_bar + pull_constants(c_bar)[0], mode="promise_in_bounds")
            return discs_bar, front_bar.at[tile].add(f_bar, mode="promise_in_bounds")

        return walk(boxes, back, (jnp.zeros_like(discs), jnp.zeros_like(front)))

    discs, front, near, boxes = saved
    discs_bar, front_bar = one_view(discs, front, near, boxes, bar)
    return discs_bar, front_bar, jnp.zeros_like(near), np.zeros(boxes.shape, jax.dtypes.float0)


def meet_backward(disc, x, y, a, b, a_bar, b_bar, depth_bar, hit):
    """Reverse mode of `meet` and `depth_at`, as four planes whose products with (a, b, 1), summed over the pixels, are
    the gradients of X, Y, W and depth.

    From k . p = 0 and m . p = 0 with p = (a, b, 1), k = X - x W, m = Y - y W: k' = -lambda p, m' = -mu p, where
    (lambda, mu) solves the transposed 2 x 2 system for what arrives at a and b.
    """
    col = lambda k: disc[:, k : k + 1]  # noqa: E731
    a_bar, b_bar = a_bar + depth_bar * col(9), b_bar + depth_bar * col(10)
    k = [col(i) - x * col(6 + i) for i in range(2)]
    m = [col(3 + i) - y * col(6 + i) for i in range(2)]
    q = k[0] * m[1] - k[1] * m[0]
    inverse = jnp.where(hit, 1 / jnp.where(q == 0, 1, q), 0)
    along, across = (a_bar * m[1] - b_bar * m[0]) * inverse, (b_bar * k[0] - a_bar * k[1]) * inverse
    return -along, -across, x * along + y * across, depth_bar


disc_sums.defvjp(_sums_forward, _sums_backward)
