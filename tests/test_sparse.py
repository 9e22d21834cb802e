"""Reverse mode for a few pixels alone equals that for all."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shapeenh.numerics import smoothstep
from shapeenh.sparse import at_ends, jumps_at, places_of, pull_near, spread
from shapeenh.stencils import derivatives, derivatives_beside, links, shift

SHAPE = (70, 90)


def bent(a, b):
    """Depends on what is two pixels away, and on where the image ends."""
    return a * shift(b, 2, 0) + jnp.sin(shift(a, -2, 1)), shift(shift(a * b, 1, 0), -1, 1)


@pytest.mark.parametrize("share", [0, 0.002, 0.3])
@pytest.mark.parametrize("shape", [SHAPE, (20, 90), (25, 24)])
def test_pulling_near_flags(x64, rng, shape, share):
    a, b, c, d = (jnp.asarray(rng.standard_normal(shape)) for _ in range(4))
    flags = rng.random(shape) < share
    flags[-1, -1] = flags[0, 0] = share > 0
    flags = jnp.asarray(flags)

    def pulled(c, d):
        return jax.vjp(lambda a: bent(a, b), a)[1]((c, d))[0]

    found = jax.jit(lambda flags, *bars: pull_near(flags, 2, bent, (a,), (b,), bars)[0])
    at_flags = jnp.where(flags, c, 0), jnp.where(flags, d, 0)
    np.testing.assert_allclose(found(flags, *at_flags), pulled(*at_flags), atol=1e-14)
    whole = found(spread(flags, 2), c, d)
    np.testing.assert_allclose(np.where(flags, whole, 0), np.where(flags, pulled(c, d), 0), atol=1e-14)


def test_spread_flags(rng):
    flags = rng.random((9, 30)) < 0.05
    wanted = np.zeros_like(flags)
    for row, column in zip(*np.nonzero(flags), strict=True):
        wanted[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3] = True
    np.testing.assert_array_equal(spread(jnp.asarray(flags), 2), wanted)


def test_the_places_and_the_ends_of_a_few_links(rng):
    image = jnp.asarray(rng.random((9, 11)), jnp.float32)
    flags = rng.random((2, 9, 11)) < 0.2
    flags[0, :, -1] = flags[1, -1] = False
    places = places_of(tuple(map(jnp.asarray, flags)), 40)
    for place, (begin, end), jump, flag, axis in zip(
        places, at_ends(image, places), jumps_at(image[None], places), flags, (1, 0), strict=True
    ):
        n = flag.sum()
        np.testing.assert_array_equal(place[:n], np.flatnonzero(flag))
        assert np.all(place[n:] == 9 * 11 - 1)
        np.testing.assert_array_equal(begin[:n], np.asarray(image)[np.nonzero(flag)])
        np.testing.assert_array_equal(end[:n], np.roll(image, -1, axis)[np.nonzero(flag)])
        np.testing.assert_array_equal(jump[0], end - begin)
        assert np.all(jump[0, n:] == 0)


def test_derivatives_beside_flanks(x64, rng):
    planes = tuple(jnp.asarray(rng.standard_normal(SHAPE)) for _ in range(2))
    x = jnp.asarray(rng.standard_normal(SHAPE) + 1.5)
    bars = [jnp.asarray(rng.standard_normal(SHAPE)) for _ in range(4)]

    def value(planes, x, beside):
        c, always = smoothstep(0.0, 1.0, x), x[0, 0] < 1e9
        link_x, link_y = links(c)
        if beside:
            link_x, link_y = jax.lax.stop_gradient((link_x, link_y))
            d_x, d_y = derivatives_beside(planes, link_x, link_y, c, always)
        else:
            d_x, d_y = derivatives(planes, link_x, link_y, always)
        return sum(jnp.vdot(a, b) for a, b in zip((*d_x, *d_y), bars, strict=True))

    found, wanted = (jax.jit(jax.grad(value, (0, 1)), static_argnums=2)(planes, x, b) for b in (True, False))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-13)
    assert np.abs(found[1]).max() > 0.1
