"""SPEC 3.5 and 3.6: the three laws, the width, the fast scheme, the adjoint."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shapeenh import heat
from shapeenh.descriptor.diffusion import diffuse_stacks, flank, levels_for
from shapeenh.numerics import smoothstep
from shapeenh.sparse import FewLinks, at, places_of
from shapeenh.stencils import links
from tests.reference import diffusion as reference

SHAPE = (64, 80)
SCHEMES = ("explicit", "fast")


@partial(jax.jit, static_argnames=("levels", "sure"))
def _run(u, c, budget, levels, sure):
    always = budget[0, 0] < 1e9
    return diffuse_stacks((u,), c, links(c), budget, None, always, levels, sure)[0]


def diffuse(u, c, sigma, scheme="explicit"):
    u, c = jnp.asarray(u), jnp.asarray(c)
    budget = jnp.full((1, 1), 0.5 * sigma**2, u.dtype)
    return np.asarray(_run(u, c, budget, -5 if scheme == "explicit" else levels_for(sigma), True))


@pytest.fixture
def obstacles():
    """A disc cut in two by a slanted line, notched by an 8-connected diagonal one, and a soft patch."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    c = np.ones(SHAPE)
    c[np.hypot(x - 40, y - 32) > 30] = 0
    c[np.abs((x - 36) - 0.37 * (y - 32)) < 0.7] = 0
    c[(x - 45 == y - 30) & (y > 20)] = 0
    c[30:36, 20:26] *= 0.5
    return c


def test_explicit_steps_equal_the_plain_loop(dtype, rng):
    u, c = rng.standard_normal((9, 11)), rng.random((9, 11)) * (rng.random((9, 11)) > 0.2)
    wanted = reference.explicit(u, *reference.links(c), 0.9)
    got = diffuse(u[None].astype(dtype), c.astype(dtype), np.sqrt(1.8))[0]
    assert got.dtype == dtype
    np.testing.assert_allclose(got, wanted, atol=1e-5 if dtype == np.float32 else 1e-12)


@pytest.mark.parametrize("levels", [-5, 2])
def test_a_batch_is_what_its_members_are(x64, rng, obstacles, levels):
    """Of a batch of sigmas each takes its own number of steps and levels, forward and in reverse."""
    u, c = jnp.asarray(rng.standard_normal((2, *SHAPE))), jnp.asarray(obstacles)

    def value(sigma):
        return jnp.sum(_run(u, c, 0.5 * jnp.square(sigma)[None, None], levels, False) ** 2)

    sigmas = jnp.asarray([0.4, 1.3, 12.0])
    together = jax.vmap(value)(sigmas), *jax.vmap(jax.value_and_grad(value))(sigmas)
    for k, sigma in enumerate(sigmas):
        wanted = value(sigma), *jax.value_and_grad(value)(sigma)
        np.testing.assert_allclose([t[k] for t in together], wanted, rtol=1e-9)


def test_every_pixel_spends_its_own_budget(x64, rng):
    u, c, steps = rng.standard_normal((9, 11)), rng.random((9, 11)), rng.integers(0, 7, (9, 11)) * 0.2
    got = _run(jnp.asarray(u[None]), jnp.asarray(c), jnp.asarray(steps), -2, True)[0]
    np.testing.assert_allclose(got, reference.explicit(u, *reference.links(c), steps), atol=1e-12)
    assert np.array_equal(np.asarray(got)[steps == 0], u[steps == 0])


# ------------------------------------------------------------------------------------------- the three laws


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("sigma", [2.0, 8.0, 20.0])
def test_laws(x64, rng, obstacles, scheme, sigma):
    from scipy.ndimage import label

    u = rng.standard_normal((2, *SHAPE))
    out = diffuse(u, obstacles, sigma, scheme)
    regions, count = label(obstacles > 0)
    assert count >= 2
    for i in range(1, count + 1):
        inside = regions == i
        np.testing.assert_allclose(out[:, inside].sum(1), u[:, inside].sum(1), atol=1e-10)
        for channel in range(2):  # no new extrema, region by region: so nothing crosses either
            assert out[channel, inside].max() <= u[channel, inside].max() + 1e-12
            assert out[channel, inside].min() >= u[channel, inside].min() - 1e-12
    np.testing.assert_array_equal(out[:, obstacles == 0], u[:, obstacles == 0])


@pytest.mark.parametrize("scheme", SCHEMES)
def test_nothing_crosses_an_insulated_line(dtype, rng, obstacles, scheme):
    from scipy.ndimage import label

    regions, _ = label(obstacles > 0)
    u = rng.standard_normal((1, *SHAPE)).astype(dtype)
    other = np.where(regions == 1, 1000 * u, u).astype(dtype)
    c = obstacles.astype(dtype)
    a, b = diffuse(u, c, 8.0, scheme), diffuse(other, c, 8.0, scheme)
    np.testing.assert_allclose(a[0, regions > 1], b[0, regions > 1], atol=1e-6)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_the_operator_is_its_own_adjoint(x64, rng, obstacles, scheme):
    u, w = rng.standard_normal((2, 1, *SHAPE))
    left = np.sum(w * diffuse(u, obstacles, 8.0, scheme))
    np.testing.assert_allclose(left, np.sum(u * diffuse(w, obstacles, 8.0, scheme)), rtol=1e-10)


# ------------------------------------------------------------------------------------------- the width


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("sigma", [1.0, 2.0, 4.0, 8.0, 16.0])
def test_sigma_is_a_gaussians(x64, scheme, sigma):
    """1 % rms on open regions, on what the grid can show of both (waves of 12 px and more)."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    u = np.sin(x / 5.0) * np.cos(y / 7.0 + 1) + 0.5 * np.cos(x / 2.5 + y / 3.0)
    out = diffuse(u[None], np.ones(SHAPE), sigma, scheme)[0]
    assert np.sqrt(np.mean((out - reference.gaussian(u, sigma)) ** 2)) <= 0.01 * np.sqrt(np.mean(u**2))


@pytest.mark.parametrize("sigma", [4.0, 8.0])
def test_fast_scheme_is_close_to_the_heat_flow_among_obstacles(x64, sigma, obstacles):
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    u = np.where(obstacles > 0, np.sin(x / 7.0) * np.cos(y / 9.0) + 0.02 * x, 0)
    exact = reference.heat_flow(u, *reference.links(obstacles), 0.5 * sigma**2)
    error = diffuse(u[None], obstacles, sigma, "fast")[0] - exact
    assert np.sqrt(np.mean(error**2)) <= 0.01 * np.sqrt(np.mean(u**2))


def test_explicit_is_continuous_in_sigma(x64, rng, obstacles):
    u = rng.standard_normal((1, *SHAPE))
    at = np.sqrt(2 * 0.2 * 5)
    np.testing.assert_allclose(diffuse(u, obstacles, at - 1e-9), diffuse(u, obstacles, at + 1e-9), atol=1e-7)
    np.testing.assert_array_equal(diffuse(u, obstacles, 0.0), u)


def test_undecided_levels_agree_with_decided_ones(x64, rng, obstacles):
    u = rng.standard_normal((1, *SHAPE))
    for sigma in (2.0, 8.0, 16.0):
        budget = jnp.full((1, 1), 0.5 * sigma**2)
        general = _run(jnp.asarray(u), jnp.asarray(obstacles), budget, 2, False)
        np.testing.assert_allclose(general, diffuse(u, obstacles, sigma, "fast"), atol=1e-12)


def test_images_one_pixel_wide(x64, rng):
    for shape in ((1, 40), (40, 1)):
        u = rng.standard_normal((1, *shape))
        for scheme in SCHEMES:
            out = diffuse(u, np.ones(shape), 8.0, scheme)
            np.testing.assert_allclose(out.sum(), u.sum(), atol=1e-12)


# ------------------------------------------------------------------------------------------- the adjoint


@pytest.mark.parametrize("budget", ["one", "map"])
def test_reverse_mode_of_explicit_steps(x64, rng, budget):
    u, c = jnp.asarray(rng.standard_normal((2, 6, 7))), jnp.asarray(rng.random((6, 7)))
    link_x, link_y = links(c.at[2].set(0))
    one = jnp.ones((1, 1))
    for time in (0.13, 3.45):
        b = jnp.full((1, 1), time) if budget == "one" else jnp.asarray(time * rng.random((6, 7)))
        run = lambda *a: heat.explicit(*a, one, None, 0.2, (3, 3, 2))  # noqa: E731  several levels of kept states
        check_grads(run, (u, link_x, link_y, b), order=1, modes=["rev"], rtol=1e-6, atol=1e-6)


def test_reverse_mode_computes_only_what_is_asked_for(x64, rng):
    """The same derivatives, whether or not those with respect to the links are computed with them."""
    u, c = jnp.asarray(rng.standard_normal((2, 6, 7))), jnp.asarray(rng.random((6, 7)))
    one, ct = jnp.ones((1, 1)), jnp.asarray(rng.standard_normal((2, 6, 7)))
    for budget in (jnp.full((1, 1), 0.93), jnp.asarray(rng.random((6, 7))), jnp.zeros((1, 1))):
        run = lambda u, x, y, b: jnp.vdot(ct, heat.explicit(u, x, y, b, one))  # noqa: E731
        at = (u, *links(c), budget)
        whole, some = jax.jit(jax.grad(run, (0, 1, 2, 3)))(*at), jax.jit(jax.grad(run, (0, 3)))(*at)
        np.testing.assert_allclose(some[0], whole[0], atol=1e-14)
        np.testing.assert_allclose(some[1], whole[3], atol=1e-14)


def test_reverse_mode_of_the_fast_scheme(x64, rng):
    u, c = jnp.asarray(rng.standard_normal((1, 12, 14))), jnp.asarray(0.5 + 0.5 * rng.random((12, 14)))
    c = c.at[:, 5].set(0)

    alive = c > 0  # at 0 the cells change: a kink

    def run(u, c, sigma):
        return _run(u, jnp.where(alive, c, 0), (0.5 * sigma**2)[None, None], 1, True)

    check_grads(run, (u, c, jnp.asarray(4.2)), order=1, modes=["rev"], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("budget", ["one", "map"])
def test_a_few_links_get_the_derivative_that_all_would_give_them(x64, rng, budget):
    u, c = jnp.asarray(rng.standard_normal((2, 6, 7))), jnp.asarray(rng.random((6, 7)))
    one, ct = jnp.ones((1, 1)), jnp.asarray(rng.standard_normal((2, 6, 7)))
    b = jnp.full((1, 1), 3.45) if budget == "one" else jnp.asarray(3.45 * rng.random((6, 7)))
    flags = [jnp.asarray(rng.random((6, 7)) < 0.2) for _ in "xy"]
    flags = flags[0].at[:, -1].set(False), flags[1].at[-1].set(False)
    places = places_of(flags, 20)

    def by_few(u, x, y, b):
        whole = jnp.pad(x, ((0, 0), (0, 1))), jnp.pad(y, ((0, 1), (0, 0)))
        few = FewLinks(tuple(map(at, whole, places)), places)
        x, y = jax.lax.stop_gradient((x, y))
        return jnp.vdot(ct, heat.explicit(u, x, y, b, one, few, 0.2, (3, 3, 2)))

    def by_all(u, x, y, b):
        return jnp.vdot(ct, heat.explicit(u, x, y, b, one, None, 0.2, (3, 3, 2)))

    few, whole = (jax.jit(jax.grad(f, (0, 1, 2, 3)))(u, *links(c), b) for f in (by_few, by_all))
    for found, wanted, where in zip(few, whole, (True, flags[0][:, :-1], flags[1][:-1], True), strict=True):
        np.testing.assert_allclose(found, np.where(where, wanted, 0), atol=1e-13)
    assert np.abs(few[1]).max() > 0


@pytest.mark.parametrize(
    ("levels", "much"), [(-2, False), (-2, True), (1, False), pytest.param(1, True, marks=pytest.mark.thorough)]
)
def test_derivative_through_flanks(x64, rng, levels, much):
    """That of conductances which come from a smoothstep, whether their flanks are followed singly or all links are."""
    u, ct = (jnp.asarray(rng.standard_normal((1, *SHAPE))) for _ in "uc")
    x, time = jnp.asarray(rng.standard_normal(SHAPE) + (1.5 if much else 3.2)), jnp.full((1, 1), 8.82)
    always = time[0, 0] < 1e9
    alive = smoothstep(0.0, 1.0, x) > 0

    @partial(jax.jit, static_argnames="marked")
    def run(u, x, time, marked):
        c = jnp.where(alive, smoothstep(0.0, 1.0, x), 0)
        marks = flank(c) if marked else None
        return jnp.vdot(ct, diffuse_stacks((u,), c, links(c), time, marks, always, levels, True, 256)[0])

    count = max(int(jnp.sum(marks)) for marks in flank(smoothstep(0.0, 1.0, x)))
    assert (count > 256) == much
    assert count > 50
    found, wanted = (jax.grad(run, (0, 1, 2))(u, x, time, marked) for marked in (True, False))
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12 * float(jnp.abs(b).max()))
