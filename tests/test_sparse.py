"""Reverse mode for a few pixels alone equals that for all."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shapeenh.numerics import smoothstep
from shapeenh.sparse import at_ends, jumps_at, places_of, pull_from, pull_to
from shapeenh.stencils import derivatives, derivatives_beside, links, shift

SHAPE = (70, 90)


def bent(_, a, b):
    """Depends on what is two pixels away, and on where the image ends."""
    return a * shift(b, 2, 0) + jnp.sin(shift(a, -2, 1)), shift(shift(a * b, 1, 0), -1, 1)


@pytest.mark.parametrize("share", [0, 0.002, 0.3])
@pytest.mark.parametrize("shape", [SHAPE, (20, 90), (13, 12), (9, 40), (5, 7)])
def test_pulling_from_and_to_flags(x64, rng, shape, share):
    a, b, c, d = (jnp.asarray(rng.standard_normal(shape)) for _ in range(4))
    flags = rng.random(shape) < share
    flags[-1, -1] = flags[0, 0] = share > 0
    flags = jnp.asarray(flags)

    def pulled(c, d):
        return jax.vjp(lambda a: bent(None, a, b), a)[1]((c, d))[0]

    def found(which):
        @jax.jit
        def run(flags, *bars):
            return which(flags, 2, bent, (a,), (b,), bars, bars[0][0, 0] < 1e9)[0]

        return run

    at_flags = jnp.where(flags, c, 0), jnp.where(flags, d, 0)
    np.testing.assert_allclose(found(pull_from)(flags, *at_flags), pulled(*at_flags), atol=1e-14)
    whole = found(pull_to)(flags, c, d)
    np.testing.assert_allclose(np.where(flags, whole, 0), np.where(flags, pulled(c, d), 0), atol=1e-14)


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
    stacks = [tuple(jnp.asarray(rng.standard_normal(SHAPE)) for _ in range(n)) for n in (2, 1)]
    x = jnp.asarray(rng.standard_normal(SHAPE) + 1.5)
    bars = [jnp.asarray(rng.standard_normal(SHAPE)) for _ in range(6)]

    def value(stacks, x, beside):
        c, always = smoothstep(0.0, 1.0, x), x[0, 0] < 1e9
        link_x, link_y = links(c)
        if beside:
            link_x, link_y = jax.lax.stop_gradient((link_x, link_y))
            d = derivatives_beside(tuple(stacks), link_x, link_y, c, always)
        else:
            d = [derivatives(planes, link_x, link_y, always) for planes in stacks]
        return sum(jnp.vdot(a, b) for a, b in zip(jax.tree.leaves(d), bars, strict=True))

    found, wanted = (jax.jit(jax.grad(value, (0, 1)), static_argnums=2)(stacks, x, b) for b in (True, False))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-13)
    assert np.abs(found[1]).max() > 0.1
