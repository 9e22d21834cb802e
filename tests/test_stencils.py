"""Masked derivatives: exactness, order up to the outline, independence of what may not be read."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from shapeenh.fusion import stored, unknown_truth
from shapeenh.stencils import derivatives, links, pair_mean

_derivatives = jax.jit(lambda u, c: [jnp.stack(d) for d in derivatives(u, *links(c), unknown_truth(u))])


def disc(h, w, radius):
    y, x = np.mgrid[:h, :w]
    return (np.hypot(x - w / 2 + 0.3, y - h / 2 + 0.2) < radius).astype(float)


def test_linear_planes_are_exact(dtype):
    y, x = np.mgrid[:40, :48]
    c = disc(40, 48, 17).astype(dtype)
    u = np.stack([2 * x - 3 * y, 0.5 * y]).astype(dtype)
    d_x, d_y = _derivatives(jnp.asarray(u), jnp.asarray(c))
    on = c > 0
    tolerance = 2e-5 if dtype == np.float32 else 1e-11
    for got, wanted in ((d_x[0], 2), (d_y[0], 3), (d_x[1], 0), (d_y[1], -0.5)):
        np.testing.assert_allclose(np.asarray(got)[on], wanted, atol=tolerance)
    assert not np.asarray(d_x)[:, ~on].any()
    assert not np.asarray(d_y)[:, ~on].any()


def test_second_order_up_to_the_outline(x64):
    """Pixels a quarter the size: errors a sixteenth, in the interior and within three pixels of the outline."""
    from scipy.ndimage import distance_transform_edt

    errors = []
    for n in (1, 4):
        h, w = 40 * n, 48 * n
        c = disc(h, w, 17 * n)
        y, x = np.mgrid[:h, :w] / n
        u = np.sin(x / 5) * np.cos(y / 6)
        d_x, _ = _derivatives(jnp.asarray(u[None]), jnp.asarray(c))
        error = np.abs(np.asarray(d_x[0]) * n - np.cos(x / 5) / 5 * np.cos(y / 6))
        rim = (c > 0) & (distance_transform_edt(np.pad(c, 1))[1:-1, 1:-1] <= 3)
        errors.append((np.median(error[(c > 0) & ~rim]), np.median(error[rim])))
    ratio = np.array(errors[0]) / np.array(errors[1])
    assert (ratio > 13).all(), ratio


def test_nothing_is_read_from_closed_pixels(x64, rng):
    c = (rng.random((20, 24)) > 0.3).astype(float)
    u = rng.standard_normal((1, 20, 24))
    other = np.where(c > 0, u, 1e6)
    for a, b in zip(*(_derivatives(jnp.asarray(v), jnp.asarray(c)) for v in (u, other)), strict=True):
        np.testing.assert_array_equal(a[:, c > 0], b[:, c > 0])


def test_turning_the_image_turns_the_derivative(x64, rng):
    """A quarter turn counter-clockwise: (d/dx, d/dy) becomes (-d/dy, d/dx) of the turned image."""
    u, c = rng.standard_normal((1, 16, 20)), (rng.random((16, 20)) > 0.2).astype(float)
    d_x, d_y = (np.asarray(d) for d in _derivatives(jnp.asarray(u), jnp.asarray(c)))
    turn = lambda a: np.rot90(a, 1, (-2, -1)).copy()  # noqa: E731
    t_x, t_y = _derivatives(jnp.asarray(turn(u)), jnp.asarray(turn(c)))
    np.testing.assert_allclose(t_x, -turn(d_y), atol=1e-12)
    np.testing.assert_allclose(t_y, turn(d_x), atol=1e-12)


def test_reverse_mode_is_the_transpose(x64, rng):
    """With respect to planes and links, at a run of closed links too; and the same when only one is asked for."""
    u, c = jnp.asarray(rng.standard_normal((2, 5, 7))), 0.3 + 0.7 * rng.random((5, 7))
    link_x, link_y = links(jnp.asarray(c))
    run = lambda u, x, y: derivatives(u, x, y, unknown_truth(u))  # noqa: E731
    check_grads(run, (u, link_x, link_y), order=1, modes=["rev"], eps=1e-6)
    closed = jnp.asarray(link_x).at[2].set(0)
    loss = lambda u, x, y: sum(jnp.vdot(w, d) for w, d in zip(weights, sum(run(u, x, y), ()), strict=True))  # noqa: E731
    weights = jnp.asarray(rng.standard_normal((4, 5, 7)))
    whole, alone = jax.grad(loss, (0, 1))(u, closed, link_y), jax.grad(loss)(u, closed, link_y)
    np.testing.assert_allclose(whole[0], alone, atol=1e-12)
    check_grads(lambda u: run(u, closed, link_y), (u,), order=1, modes=["rev"])


@settings(max_examples=8, deadline=None)
@given(st.sampled_from([(1, 7), (7, 1), (3, 5)]), st.integers(0, 2**31))
def test_small_images_stay_finite_with_finite_gradients(shape, seed):
    rng = np.random.default_rng(seed)
    u = jnp.asarray(rng.standard_normal((1, *shape)), jnp.float32)
    c = jnp.asarray(rng.random(shape) * (rng.random(shape) > 0.3), jnp.float32)
    loss = lambda u, c: sum(jnp.sum(d) for d in _derivatives(u, c))  # noqa: E731
    value, grads = jax.jit(jax.value_and_grad(loss, (0, 1)))(u, c)
    assert np.isfinite(value)
    assert all(np.isfinite(g).all() for g in grads)


def test_pair_mean(dtype):
    a = jnp.asarray([0, 0, 1, 0.5], dtype)
    b = jnp.asarray([0, 1, 1, 0.25], dtype)
    np.testing.assert_allclose(pair_mean(a, b), [0, 0, 1, 1 / 3], rtol=1e-6)
    np.testing.assert_array_equal(jax.grad(lambda a: jnp.sum(pair_mean(a, b)))(a)[:1], [0])


def test_stored_is_transparent(x64):
    f = lambda x: (x * 2, x + 1)  # noqa: E731
    x = jnp.arange(4.0)
    for got, wanted in zip(jax.jit(lambda x: stored(unknown_truth(x), f, x))(x), f(x), strict=True):
        np.testing.assert_array_equal(got, wanted)
    assert bool(unknown_truth(jnp.asarray([jnp.nan]), jnp.asarray([-jnp.inf, 1.0]), jnp.asarray(0.99)))
