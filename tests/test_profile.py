"""Profiles of feature lines: the thesis' rippled surface, laws, the NumPy twin, gradients, edge cases."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

import shapeenh as se
from shapeenh.lines import profile as module
from shapeenh.types import LineField, Profile, replace
from tests.reference import lines as reference

# ------------------------------------------------------------------------------------------- ripples (TH10 fig. 7.2)
#
# One unit of |x| is 4 px: circles lie 25 px apart, so that a neighbourhood of ±4 px sees a third of a wave. A cubic is
# no cosine, and a bilinear read no height: both errors grow with the square of that part and more.

UNIT = 4.0
SIZE = 96


def ripples_at(r):
    return np.cos(r / UNIT) / (1 + 0.2 * r / UNIT)


def circles():
    """Radii in px at which the height along a ray has a maximum, and a minimum."""
    slope = lambda r: -np.sin(r) * (1 + 0.2 * r) - 0.2 * np.cos(r)  # noqa: E731
    return [UNIT * brentq(slope, a - 1.5, a + 0.5) for a in (2 * np.pi, np.pi, 3 * np.pi)]


def ripples(shift=(0.0, 0.0), flip=None, dtype=np.float32, centre=(-10.0, -10.0)):
    """(field, radius from the centre): the waves' centre lies towards the lower left, so that more of a circle fits."""
    row, col = np.mgrid[0:SIZE, 0:SIZE]
    x, y = col - SIZE / 2 + 0.5 - centre[0] + shift[0], SIZE / 2 - 0.5 - row - centre[1] + shift[1]
    r = np.hypot(x, y)
    theta = np.stack([x, y], -1) / np.where(r == 0, 1, r)[..., None]
    gamma = reference.direction_singularity(theta, np.ones((SIZE, SIZE), bool)) if flip is None else None
    if flip is not None:
        theta = theta * np.where(flip, -1, 1)[..., None]
        gamma = reference.direction_singularity(theta, np.ones((SIZE, SIZE), bool))
    return LineField(*(jnp.asarray(a, dtype) for a in (ripples_at(r), theta, gamma))), r


SHIFTS = [tuple(s) for s in np.random.default_rng(7).uniform(-0.5, 0.5, (8, 2)).round(3)]


@pytest.mark.parametrize("shift", [(0.0, 0.0), *SHIFTS])
def test_ripples_have_circles_for_skeletons(shift):
    field, r = ripples(shift)
    found = se.fit_profile(field)
    radius = circles()[0]
    near = np.abs(r - radius) <= 3
    assert np.all(np.asarray(found.valid)[near])
    # positions: from any pixel one lands on the circle, along the ray
    error = np.abs(r + np.asarray(found.distance) - radius)[near]
    assert np.percentile(error, 99) < 0.15
    height = np.asarray(found.height)[near]
    assert np.max(np.abs(height / ripples_at(radius) - 1)) < 0.02
    assert np.max(np.asarray(found.curvature)[near]) < 0


def test_ripples_have_no_line_in_the_troughs():
    field, r = ripples()
    found = se.fit_profile(field)
    for trough in circles()[1:]:
        assert not np.any(np.asarray(found.valid)[np.abs(r - trough) <= 3])


def test_curvature_is_that_of_the_waves():
    field, r = ripples(dtype=np.float32)
    found = se.fit_profile(field)
    radius, h = circles()[0], 1e-3
    exact = (ripples_at(radius + h) - 2 * ripples_at(radius) + ripples_at(radius - h)) / h**2
    on = np.abs(r - radius) <= 0.5
    np.testing.assert_allclose(np.asarray(found.curvature)[on], exact, rtol=0.15)


@pytest.mark.parametrize("quarter", [1, 2])
def test_a_rotated_picture_has_rotated_profiles(quarter):
    field, _ = ripples()
    turn = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarter]
    x, y = field.direction[..., 0], field.direction[..., 1]
    turned = LineField(
        jnp.rot90(field.height, quarter),
        jnp.rot90(jnp.stack([turn[0] * x - turn[1] * y, turn[1] * x + turn[0] * y], -1), quarter),
        jnp.rot90(field.singularity, quarter),
    )
    a, b = se.fit_profile(field), se.fit_profile(turned)
    for name, scale in (("distance", 1.0), ("height", 1.0), ("curvature", 0.03)):
        expected = np.rot90(np.asarray(getattr(a, name)), quarter)
        both = np.rot90(np.asarray(a.valid), quarter) & np.asarray(b.valid)
        np.testing.assert_allclose(np.asarray(getattr(b, name))[both], expected[both], atol=1e-3 * scale)
    assert np.mean(np.rot90(np.asarray(a.valid), quarter) != np.asarray(b.valid)) < 1e-3


def test_directions_are_lines_not_arrows(rng):
    flip = rng.random((SIZE, SIZE)) < 0.5
    (plain, _), (flipped, _) = ripples(), ripples(flip=flip)
    a, b = se.fit_profile(plain), se.fit_profile(flipped)
    np.testing.assert_array_equal(a.valid, b.valid)
    np.testing.assert_allclose(b.distance, np.where(flip, -1, 1) * np.asarray(a.distance), atol=1e-4)
    np.testing.assert_allclose(b.height, a.height, atol=1e-6)


# ------------------------------------------------------------------------------------------- no lines


def constant_field(height, direction=(1.0, 0.0), dtype=np.float32):
    h = jnp.asarray(height, dtype)
    return LineField(h, jnp.broadcast_to(jnp.asarray(direction, dtype), (*h.shape, 2)), jnp.zeros_like(h))


@pytest.mark.parametrize("angle", [0.0, 0.8])
@pytest.mark.parametrize("height", [1234.567])
def test_planes_have_no_lines(angle, height, dtype):
    row, col = np.mgrid[0:SIZE, 0:SIZE]
    direction = (np.cos(angle), np.sin(angle))
    for slope in (0.0, 0.01, 0.7):
        plane = height + slope * (0.6 * col - 0.8 * row)
        assert not np.any(se.fit_profile(constant_field(plane, direction, dtype), least=-np.inf).valid)


def test_no_line_where_the_direction_is_undefined():
    field, _ = ripples()
    hole = np.zeros((SIZE, SIZE), bool)
    hole[20:40, 50:70] = True
    theta = jnp.where(hole[..., None], 0, field.direction)
    found = se.fit_profile(LineField(field.height, theta, field.singularity))
    assert not np.any(np.asarray(found.valid)[hole])
    assert not np.any(np.asarray(found.distance)[hole])


def test_least_drops_the_profiles_that_are_not_higher():
    field, _ = ripples()
    every, high = se.fit_profile(field), se.fit_profile(field, least=0.4)
    np.testing.assert_array_equal(high.valid, np.asarray(every.valid) & (np.asarray(every.height) > 0.4))
    assert 0 < np.sum(high.valid) < np.sum(every.valid)
    np.testing.assert_array_equal(high.distance, np.where(high.valid, every.distance, 0))


@jax.jit
def everywhere(field, least):
    """Profiles of all pixels, whether or not there can be one."""
    planes = module.planes_of(field)
    row, col = (jnp.asarray(i, jnp.int32) for i in np.indices(field.height.shape))
    return Profile(*module._fit(planes[:2], row, col, *planes[2:], least, radius=4.0, samples=9))


def test_skipping_pixels_changes_nothing():
    plain, _ = ripples()
    walled = replace(plain, singularity=plain.singularity.at[:, 7].set(1).at[9].set(0.4))
    for field, least in [(plain, -np.inf), (plain, 0.0), (plain, 0.4), (walled, 0.0)]:
        every = everywhere(field, least)
        assert np.any(every.valid)
        for some in (se.fit_profile(field, least=least), jax.jit(se.fit_profile)(field, least=least)):
            np.testing.assert_array_equal(some.valid, every.valid)
            np.testing.assert_allclose(some.distance, every.distance, atol=1e-5)
            np.testing.assert_allclose(some.height, every.height, atol=1e-6)


def test_gradients_of_listed_pixels_are_those_of_all(x64):
    plain, _ = ripples()
    field = replace(plain, singularity=plain.singularity.at[:, 7].set(0.9).at[9].set(0.4))
    field = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), field)
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(3, *field.height.shape)))

    def loss(fit):
        def weighed(field):
            found = fit(field, least=0.0)
            planes = jnp.stack([found.distance, found.height, found.curvature])
            return jnp.sum(weights * planes)

        return jax.jit(jax.grad(weighed))(field)

    for some, every in zip(*(jax.tree.leaves(loss(fit)) for fit in (se.fit_profile, everywhere)), strict=True):
        assert np.any(np.asarray(every) != 0)
        np.testing.assert_allclose(some, every, atol=1e-12 * np.max(np.abs(every)))


# ------------------------------------------------------------------------------------------- singularities


def parabola(at, size=21, dtype=np.float32):
    x = np.arange(size) - at
    return np.broadcast_to(1 - 0.02 * x**2, (size, size)).astype(dtype)


def test_parabolas_are_found_exactly_up_to_the_interpolation():
    for at in (9.0, 10.0, 10.5, 11.3):
        found = se.fit_profile(constant_field(parabola(at)))
        x = np.arange(21)
        inside = (np.abs(x - at) <= 3.4) & (x >= 5) & (x <= 15)
        assert np.all(np.asarray(found.valid)[:, inside])
        # read at pixel centres along a row, a parabola is a parabola
        np.testing.assert_allclose((x + np.asarray(found.distance))[:, inside], at, atol=1e-3)
        np.testing.assert_allclose(np.asarray(found.curvature)[:, inside], -0.04, rtol=1e-3)


@pytest.mark.parametrize("direction", [(1.0, 0.0), (np.sqrt(0.5), -np.sqrt(0.5)), (0.8, 0.6), (0.95, 0.31)])
def test_a_wall_one_pixel_thick_stops_every_trajectory(direction):
    """A maximum on the far side of a singular line (8-connected, as silhouettes are) is never seen."""
    row, col = np.mgrid[0:41, 0:41]
    across = (col - 20) * direction[0] - (row - 20) * direction[1]
    gamma = np.zeros((41, 41))
    if abs(direction[0]) >= abs(direction[1]):
        for i in range(41):
            gamma[i, int(np.clip(round(20 + (i - 20) * direction[1] / direction[0]), 0, 40))] = 1
    field = LineField(
        jnp.asarray(np.exp(-((across - 3.0) ** 2) / 8), jnp.float32),
        jnp.broadcast_to(jnp.asarray(direction, jnp.float32), (41, 41, 2)),
        jnp.asarray(gamma, jnp.float32),
    )
    found = se.fit_profile(field)
    middle = (np.abs(row - 20) < 12) & (np.abs(col - 20) < 12)
    target = across + np.asarray(found.distance)
    near_side = middle & (across < -0.8) & np.asarray(found.valid)
    assert not np.any(target[near_side] > 0.5)
    far_side = middle & (across > 2.5) & (across < 4)
    assert np.mean(np.asarray(found.valid)[far_side]) > 0.9


def test_a_shrunk_neighbourhood_reads_nothing_beyond_the_singularity():
    height = parabola(9.0)
    gamma = np.zeros_like(height)
    gamma[:, 12] = 1
    for beyond in (-50.0, 0.0, 50.0):
        h = height.copy()
        h[:, 12:] = beyond
        theta = constant_field(h).direction
        found = se.fit_profile(LineField(jnp.asarray(h), theta, jnp.asarray(gamma)))
        on = np.s_[:, 7:10]
        assert np.all(np.asarray(found.valid)[on])
        np.testing.assert_allclose(
            (np.arange(21) + np.asarray(found.distance))[on], 9.0, atol=0.02
        )  # a bilinear read is no parabola
        assert not np.any(np.asarray(found.valid)[:, 12])


# ------------------------------------------------------------------------------------------- the twin


@pytest.mark.parametrize(("radius", "samples"), [(4.0, 9), pytest.param(2.5, 7, marks=pytest.mark.slow)])
def test_equals_the_twin(radius, samples, dtype, rng):
    h, w = 17, 22
    coarse = rng.normal(size=(h + 8, w + 8))
    smooth = sum(np.roll(coarse, (i, j), (0, 1)) for i in range(-2, 3) for j in range(-2, 3))[4:-4, 4:-4] / 5
    angle = np.cumsum(rng.normal(size=(h, w)) * 0.2, axis=1)
    direction = np.stack([np.cos(angle), np.sin(angle)], -1)
    direction[rng.random((h, w)) < 0.05] = 0
    gamma = np.where(rng.random((h, w)) < 0.03, 1.0, 0.1 * rng.random((h, w)))
    arrays = [np.asarray(a, dtype) for a in (smooth, direction, gamma)]
    found = se.fit_profile(LineField(*map(jnp.asarray, arrays)), radius=radius, samples=samples, least=-np.inf)
    *expected, valid = reference.profile(*arrays, radius=radius, samples=samples, least=-np.inf)
    assert found.height.dtype == dtype
    assert valid.sum() > 50
    same = np.asarray(found.valid) == valid
    assert same.mean() > (0.99 if dtype == np.float32 else 0.997)  # a discriminant below 1e-6 is no maximum to us
    both = np.asarray(found.valid) & valid
    tolerance = 2e-3 if dtype == np.float32 else 1e-9
    for got, want in zip((found.distance, found.height, found.curvature), expected, strict=True):
        np.testing.assert_allclose(np.asarray(got)[both], want[both], rtol=tolerance, atol=tolerance)


def test_the_matrix_reproduces_cubics():
    for samples in (5, 9, 33):
        t = np.linspace(-1, 1, samples)
        cubic = np.array([0.3, -1.2, 0.5, 2.0])
        np.testing.assert_allclose(module.least_squares_matrix(samples) @ np.polyval(cubic, t), cubic, atol=1e-13)


def test_the_cubic_term_may_vanish(x64):
    """a -> 0: the root is c/(-b + sqrt(D)), not a quotient of zeros; symmetrical profiles have a = 0 exactly."""
    found = se.fit_profile(constant_field(parabola(10.0, dtype=np.float64), dtype=np.float64))
    np.testing.assert_allclose(np.asarray(found.distance)[:, 10], 0, atol=1e-12)
    # a fitted parabola of tiny cubic part, either sign
    x = np.arange(21.0) - 10
    for a in (1e-9, -1e-9, 0):
        h = np.broadcast_to(1 - 0.02 * x**2 + 0.01 * x + a * x**3, (21, 21))
        found = se.fit_profile(constant_field(h, dtype=np.float64))
        np.testing.assert_allclose(np.asarray(found.distance)[:, 10], 0.25, atol=1e-5)


# ------------------------------------------------------------------------------------------- gradients


def test_gradients_are_finite_at_singular_points(rng):
    """Planes, undefined directions, walls, noise, ties, and heights of any size."""
    h, w = 12, 13

    def total(*arrays):
        found = se.fit_profile(LineField(*arrays), least=-np.inf, radius=2.0, samples=5)
        return jnp.sum(found.distance) + jnp.sum(found.height) + jnp.sum(found.curvature)

    gradients = jax.jit(jax.grad(total, argnums=(0, 1, 2)))
    theta = np.zeros((h, w, 2))
    theta[:, :6] = (1, 0)
    gamma = np.where(rng.random((h, w)) < 0.2, 1.0, 0.0)
    spike = np.zeros((h, w))
    spike[5, 3] = 1
    for height in (np.zeros((h, w)), np.ones((h, w)), rng.normal(size=(h, w)), spike, 1e30 * spike, 1e-30 * spike):
        for gradient in gradients(*(jnp.asarray(a, jnp.float32) for a in (height, theta, gamma))):
            assert np.all(np.isfinite(gradient))


def test_vmap_and_jit():
    fields = [jax.tree.map(lambda a: a[:20, -24:], ripples(s)[0]) for s in SHIFTS[:2]]
    stacked = jax.tree.map(lambda *a: jnp.stack(a), *fields)
    together = jax.vmap(se.fit_profile)(stacked)
    for k, field in enumerate(fields):
        alone = se.fit_profile(field)
        np.testing.assert_array_equal(together.valid[k], alone.valid)
        np.testing.assert_allclose(together.distance[k], alone.distance, atol=1e-5)


# ------------------------------------------------------------------------------------------- edge cases


@pytest.mark.parametrize("shape", [(1, 1), (1, 9)])
def test_thin_images(shape, rng):
    field = constant_field(rng.normal(size=shape), direction=(0.6, 0.8))
    found = se.fit_profile(field, least=-np.inf)
    assert found.valid.shape == shape
    assert all(np.all(np.isfinite(a)) for a in (found.distance, found.height, found.curvature))


@given(st.lists(st.sampled_from([0.0, 1.0, -1.0, 0.5, 1e30, -1e30, np.nan, np.inf]), min_size=56, max_size=56))
@settings(max_examples=20, deadline=None)
def test_any_values_give_finite_profiles(values):
    height = np.resize(np.float32(values), (7, 8))
    theta = np.resize(np.float32(values)[::-1], (7, 8, 2))
    gamma = np.resize(np.roll(np.float32(values), 3), (7, 8))
    found = se.fit_profile(LineField(*map(jnp.asarray, (height, theta, gamma))), least=-np.inf)
    for a in (found.distance, found.height, found.curvature):
        assert np.all(np.isfinite(a))
        assert not np.any(np.asarray(a)[~np.asarray(found.valid)])
    assert np.all(np.abs(found.distance) <= 4 * (1 + 1e-6))


def test_bad_pixels_do_not_poison_good_ones():
    clean, _ = ripples()
    bad = np.zeros((SIZE, SIZE), bool)
    bad[60:70, 30:50] = True
    theta = jnp.where(bad[..., None], jnp.nan, clean.direction)
    dirty = LineField(jnp.where(bad, jnp.nan, clean.height), theta, clean.singularity)
    a, b = se.fit_profile(clean), se.fit_profile(dirty)
    away = np.ones((SIZE, SIZE), bool)
    away[54:76, 24:56] = False
    for name in ("distance", "height", "curvature", "valid"):
        np.testing.assert_array_equal(np.asarray(getattr(a, name))[away], np.asarray(getattr(b, name))[away])
    assert np.all(np.isfinite(b.distance))
    assert not np.any(np.asarray(b.valid)[bad])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"radius": 0.5}, "radius"),
        ({"radius": np.nan}, "radius"),
        ({"samples": 8}, "samples"),
        ({"samples": 3}, "samples"),
        ({"least": np.nan}, "least"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        se.fit_profile(constant_field(np.zeros((5, 5))), **arguments)


def test_bad_fields_are_named():
    good = constant_field(np.zeros((5, 5)))
    with pytest.raises(ValueError, match=r"field\.direction has shape"):
        se.fit_profile(LineField(good.height, good.direction[:4], good.singularity))
    with pytest.raises(ValueError, match="accepted is a LineField"):
        se.fit_profile(good.height)
