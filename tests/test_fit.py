"""Contrast, and parameters fitted to it or to a picture (SPEC 12)."""

import argparse
import json
import re
import subprocess
import sys

import hypothesis
import hypothesis.extra.numpy as arrays
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from shapeenh.cli import main
from shapeenh.cli.fit import report
from shapeenh.fit.box import Box
from shapeenh.fit.search import shortest_step, survey_points
from tests.reference import contrast as twin
from tests.reference.differences import assert_gradient

MEASURES = ("rms", "michelson", "band")
EPS = {"float32": 2e-5, "float64": 1e-12}  # sums of some hundred pixels, differences of nearly equal blurs


def disc(height=24, width=30):
    y, x = np.mgrid[0:height, 0:width]
    return (x - width / 2) ** 2 + (y - height / 2) ** 2 < (0.45 * min(height, width)) ** 2


# ------------------------------------------------------------------------------------------- contrast: laws


@pytest.mark.parametrize("measure", MEASURES)
def test_contrast_does_not_change_with_exposure_nor_with_what_lies_off_the_mask(measure, dtype, rng):
    mask = disc()
    image = rng.uniform(0.1, 1, (*mask.shape, 3)).astype(dtype)
    value = se.contrast(image, mask, measure=measure)
    assert value.shape == ()
    assert value.dtype == dtype
    assert value > 0.01
    for factor in (0.25, 7.0, 1e6, 1e-6):
        scaled = se.contrast((image * factor).astype(dtype), mask, measure=measure)
        assert scaled == pytest.approx(float(value), rel=EPS[dtype.name])
    other = np.where(mask[..., None], image, rng.uniform(0, 100, image.shape)).astype(dtype)
    assert se.contrast(other, mask, measure=measure) == value
    other[~mask] = np.nan
    assert se.contrast(other, mask, measure=measure) == value


@pytest.mark.parametrize("measure", MEASURES)
def test_uniform_black_and_absent_pictures_have_no_contrast(measure, dtype):
    mask = disc()
    uniform = np.full((*mask.shape, 3), [0.3, 0.7, 0.1], dtype)
    assert se.contrast(uniform, mask, measure=measure) < 4 * jnp.finfo(dtype).eps
    for image, where in ((0 * uniform, mask), (uniform, np.zeros_like(mask)), (np.nan * uniform, mask)):
        assert se.contrast(image, where, measure=measure) == 0
        assert np.all(jax.grad(lambda i, w=where: se.contrast(i, w, measure=measure))(image) == 0)


def test_two_values(dtype):
    """Half a, half b: rms = (a - b)/(a + b) and so is Michelson's; in thirds they differ."""
    image = np.full((10, 30), 0.2, dtype)
    image[:, :15] = 0.6
    mask = np.ones(image.shape, bool)
    assert se.contrast(image, mask) == pytest.approx(0.5, rel=EPS[dtype.name])
    assert se.contrast(image, mask, measure="michelson") == pytest.approx(0.5, rel=EPS[dtype.name])
    image[:, 10:] = 0.2
    mean, square = (0.6 + 2 * 0.2) / 3, (0.36 + 2 * 0.04) / 3
    assert se.contrast(image, mask) == pytest.approx(np.sqrt(square - mean**2) / mean, rel=EPS[dtype.name])
    assert se.contrast(image, mask, measure="michelson") == pytest.approx(0.5, rel=EPS[dtype.name])


def test_michelson_does_not_see_stray_pixels(rng):
    image = rng.uniform(0.2, 0.8, (40, 50))
    mask = np.ones(image.shape, bool)
    plain = se.contrast(image, mask, measure="michelson")
    image[3, 4], image[20, 30] = 1e6, 0.0
    assert se.contrast(image, mask, measure="michelson") == pytest.approx(float(plain), abs=0.01)
    assert se.contrast(image, mask) > 10


def test_band_of_a_wave_is_what_the_heat_flow_leaves_of_it(x64):
    """cos(k (i + 1/2)), k = pi m/W, is an eigenvector of the flow with reflecting ends."""
    width, k, amplitude = 60, np.pi * 12 / 60, 0.3
    image = np.tile(1 + amplitude * np.cos(k * (np.arange(width) + 0.5)), (7, 1))
    decay = 1 - 2 * 0.2 * (1 - np.cos(k))
    for scale in (1.0, 2.0, 3.0):
        steps = round(scale**2 / 0.4)
        expected = amplitude / np.sqrt(2) * (decay**steps - decay ** (4 * steps))
        got = se.contrast(image, np.ones(image.shape, bool), measure="band", scale=scale)
        assert got == pytest.approx(expected, rel=1e-10)


def test_band_does_not_count_the_outline(dtype):
    """A bright object with no detail before a black ground: the mask alone decides what is an edge."""
    mask = disc()
    image = np.where(mask, 0.8, 0).astype(dtype)
    assert se.contrast(image, mask, measure="band") < 4 * jnp.finfo(dtype).eps
    assert se.contrast(image, np.ones_like(mask), measure="band") > 0.05


# ------------------------------------------------------------------------------------------- contrast: twin, gradient


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("shape", [(1, 9), (17, 12, 3), (40, 23)])
def test_contrast_equals_its_twin(measure, shape, dtype, rng):
    image = rng.gamma(2.0, size=shape)
    image[0, 0] *= -1  # negative light counts as none
    mask = rng.random(shape[:2]) < 0.8
    mask[0, 0] = True
    expected = getattr(twin, measure)(image.astype(dtype), mask)
    assert se.contrast(image.astype(dtype), mask, measure=measure) == pytest.approx(
        expected, rel=20 * EPS[dtype.name], abs=EPS[dtype.name]
    )


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("shape", [(1, 9), (9, 12, 3)])
def test_contrast_gradient(measure, shape, x64, rng):
    image = jnp.asarray(rng.gamma(2.0, size=shape))
    mask = rng.random(shape[:2]) < 0.8
    assert_gradient(lambda i: se.contrast(i, mask, measure=measure), image, rtol=1e-5)


@hypothesis.settings(deadline=None, max_examples=40, derandomize=True)
@hypothesis.given(
    image=arrays.arrays(
        np.float32,
        st.sampled_from([(1, 1), (5, 1), (2, 3, 3)]),
        elements=st.one_of(
            st.floats(width=32, allow_nan=True, allow_infinity=True), st.sampled_from([0.0, 1.0, 1e-30, 1e30, -1.0])
        ),
    ),
    bits=st.integers(0, 2**12 - 1),
    measure=st.sampled_from(MEASURES),
)
def test_contrast_of_any_picture_is_finite_and_so_is_its_gradient(image, bits, measure):
    size = image.shape[0] * image.shape[1]
    mask = np.array([bits >> k & 1 for k in range(size)], bool).reshape(image.shape[:2])
    value, gradient = jax.value_and_grad(lambda i: se.contrast(i, mask, measure=measure))(jnp.asarray(image))
    assert np.isfinite(value)
    assert value >= 0
    assert np.all(np.isfinite(gradient))
    counts = mask & np.isfinite(image).reshape(*mask.shape, -1).all(-1)
    assert np.all(np.asarray(gradient)[~counts] == 0)
    if measure == "michelson":
        assert value <= 1 + 1e-6


def test_michelson_contrast_never_rounds_below_zero():
    """Three counting pixels of one luminance, averaged with the weights of either end: high - low was -3.5e-8."""
    image = np.zeros((2, 3, 3), np.float32)
    image[1, 1] = 1, 0, 0
    for bits in range(2**6):
        mask = np.array([bits >> k & 1 for k in range(6)], bool).reshape(2, 3)
        assert 0 <= float(se.contrast(image, mask, measure="michelson")) <= 1 + 1e-6


def test_contrast_under_jit_and_vmap(rng):
    mask = disc()
    images = rng.uniform(0.1, 1, (3, *mask.shape)).astype(np.float32)
    for measure in MEASURES:
        one_by_one = [float(se.contrast(i, mask, measure=measure)) for i in images]
        batched = jax.vmap(lambda i, m=measure: se.contrast(i, mask, measure=m))(images)
        under_jit = jax.jit(lambda i, m=measure: se.contrast(i, mask, measure=m))
        jitted = [float(under_jit(i)) for i in images]
        np.testing.assert_allclose(batched, one_by_one, rtol=1e-6)
        np.testing.assert_allclose(jitted, one_by_one, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"measure": "weber"}, "measure is 'weber'"),
        ({"scale": 0.0}, "scale is 0"),
        ({"scale": np.nan}, "scale is nan"),
        ({"image": np.zeros(4)}, "image has shape"),
        ({"image": np.zeros((4, 4, 4))}, "image has shape"),
        ({"mask": np.zeros((3, 4), bool)}, "mask has shape"),
    ],
)
def test_contrast_names_bad_input(change, words):
    given = {"image": np.zeros((4, 4)), "mask": np.ones((4, 4), bool)} | change
    image, mask = given.pop("image"), given.pop("mask")
    with pytest.raises(ValueError, match=words):
        se.contrast(image, mask, **given)


# ------------------------------------------------------------------------------------------- pictures to fit


def bumps(height=24, width=30):
    """A height field, its mask, and its slopes."""
    y, x = np.mgrid[0:height, 0:width] / 12.0
    return np.sin(3 * x) * np.cos(2.5 * y), disc(height, width)


HEIGHT, MASK = bumps()


@jax.jit
def shaded(parameters):
    """A picture whose contrast grows with the size of alpha, whatever its sign: flat at alpha = 0."""
    alpha, gamma = parameters["alpha"], parameters["gamma"]
    height = HEIGHT.astype(jnp.result_type(alpha))
    return 0.5 * (1 + 0.6 * jnp.tanh(alpha * height / 20)) * jnp.exp(gamma * height)


def of_alpha(alpha):
    return shaded({"alpha": jnp.asarray(alpha), "gamma": jnp.zeros_like(alpha)})


@jax.jit
def waving(alpha):
    """Contrast that rises, falls and rises again between alpha = 0 and 100."""
    strength = 0.3 + 0.25 * jnp.sin(alpha / 12) + alpha / 400
    return 1 + strength * HEIGHT.astype(jnp.result_type(alpha))


BOUNDS = {"alpha": (-40.0, 100.0), "gamma": (-1.0, 1.0)}


def contrast_of(image, measure="rms"):
    return float(se.contrast(image, MASK, measure=measure))


# ------------------------------------------------------------------------------------------- fit_contrast


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("start", [(0.0, 0.0), (1.0, 0.0), (100.0, 1.0), (-40.0, -1.0), (50.0, -0.3)])
def test_the_target_is_met_from_any_start(measure, start, dtype):
    target = {"rms": 0.25, "michelson": 0.3, "band": 0.05}[measure]
    parameters = dict(zip(("alpha", "gamma"), (jnp.asarray(s, dtype) for s in start), strict=True))
    fitted = se.fit_contrast(shaded, target, parameters, mask=MASK, bounds=BOUNDS, measure=measure)
    assert fitted.converged is True
    assert fitted.value == pytest.approx(target, rel=1.01e-4)
    assert contrast_of(shaded(fitted.parameters), measure) == pytest.approx(target, rel=1.1e-4)
    for name, (low, high) in BOUNDS.items():
        assert fitted.parameters[name].dtype == dtype
        assert low <= fitted.parameters[name] <= high
    assert 1 <= fitted.renders <= 40
    assert fitted.reason == ""


@pytest.mark.parametrize("start", np.linspace(0, 100, 9))
@pytest.mark.parametrize("target", [0.2, 0.27, 0.36])
def test_a_contrast_that_rises_and_falls_is_met_from_any_start(start, target):
    fitted = se.fit_contrast(waving, target, start, mask=MASK, bounds=(0.0, 100.0))
    assert fitted.converged
    assert contrast_of(waving(fitted.parameters)) == pytest.approx(target, rel=1.1e-4)
    assert fitted.renders <= 30


# ------------------------------------------------------------------------------------------- every parameter

DEFAULTS = {
    "alpha": 20.0,
    "contrast": 0.2,
    "sigma": 1.0,
    "invariant": 0.4,
    "gamma": 4.0,
    "anisotropy": 0.2,
    "rotation": 0.0,
    "intensity": 1.0,
}
RANGES = {
    "alpha": (0.0, 60.0),
    "contrast": (-0.8, 0.8),
    "sigma": (0.3, 3.0),
    "invariant": (0.1, 0.8),
    "gamma": (0.0, 12.0),
    "anisotropy": (-1.0, 1.0),
    "rotation": (-0.6, 0.6),
    "intensity": (0.2, 5.0),
}


@pytest.fixture(scope="module")
def whole_picture():
    """(parameters -> picture, mask): a bumpy ball, warped and scaled, its lights turned, one of them made brighter.

    Parameters that are not given keep their defaults. They reach the compiled function as one vector, so that every
    choice of what is fitted runs the same two programs: the picture, and its gradient.
    """
    row, column = np.mgrid[:18, :24]
    x, y = (column - 11.5) / 8.5, (8.5 - row) / 8.5
    mask = x * x + y * y < 1
    z = np.sqrt(np.maximum(1 - x * x - y * y, 0)) + 0.1
    normal = np.stack([x + 0.2 * np.sin(5 * x), y + 0.2 * np.sin(4 * y), z], axis=-1) * mask[..., None]
    normal = jnp.asarray(normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 0.1), jnp.float32)
    gbuffer = se.GBuffer(jnp.asarray(mask), jnp.asarray(3.0 * mask, jnp.float32), normal, normal)
    rng = np.random.default_rng(5)
    direction = rng.normal(size=(6, 3)) + [0, 0, 0.7]
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    lights = se.Lights(*(jnp.asarray(a, jnp.float32) for a in (direction, rng.uniform(0.1, 1, (6, 3)))))
    material = se.Material(jnp.full(3, 0.6))  # without highlights, which only take long to compile
    brightest = jnp.argmax(jnp.sum(lights.radiance, axis=-1))

    @jax.jit
    def picture(values):
        p = dict(zip(DEFAULTS, values, strict=True))
        c, s = jnp.cos(p["rotation"]), jnp.sin(p["rotation"])
        x, y, z = lights.direction.T
        turned = jnp.stack([c * x + s * z, y, c * z - s * x], axis=-1)
        lit = se.Lights(turned, lights.radiance.at[brightest].multiply(p["intensity"]))
        return se.shade_scaled(
            gbuffer,
            se.describe(gbuffer, sigma=p["sigma"], scheme="explicit"),
            lit,
            material,
            invariant=p["invariant"],
            gamma_diffuse=p["gamma"],
            gamma_specular=0.0,
            anisotropy=p["anisotropy"],
            alpha=p["alpha"],
            contrast=p["contrast"],
        )

    def render(p):
        return picture(jnp.stack([jnp.asarray(v, jnp.float32) for v in (DEFAULTS | p).values()]))

    return render, np.asarray(gbuffer.mask)


@pytest.mark.slow
@pytest.mark.parametrize("names", [*((name,) for name in DEFAULTS), tuple(DEFAULTS)], ids="+".join)
def test_parameters_of_every_stage_are_fitted_singly_and_together(names, whole_picture):
    """The target is the contrast at a hidden value; another value may reach it too, so the contrast is compared."""
    render, mask = whole_picture
    bounds = {name: RANGES[name] for name in names}
    hidden = {name: low + 0.7 * (high - low) for name, (low, high) in bounds.items()}
    start = {name: low + 0.2 * (high - low) for name, (low, high) in bounds.items()}
    target = float(se.contrast(render(hidden), mask))
    assert abs(float(se.contrast(render(start), mask)) / target - 1) > 1e-3  # the start is not the answer
    fitted = se.fit_contrast(render, target, start, mask=mask, bounds=bounds)
    assert fitted.converged
    assert float(se.contrast(render(fitted.parameters), mask)) == pytest.approx(target, rel=1.1e-4)
    for name, (low, high) in bounds.items():
        assert low <= fitted.parameters[name] <= high
        assert fitted.parameters[name] != np.float32(start[name])


def solvers(*names, compiled=()):
    """Pairs of a solver and a precision; of those that compile their whole loop, the second only before a release."""
    slow = {"float32": pytest.mark.slow, "float64": pytest.mark.thorough}
    return [(name, dtype) for name in names for dtype in slow] + [
        pytest.param(name, dtype, marks=slow[dtype]) for name in compiled for dtype in slow
    ]


@pytest.mark.parametrize(
    ("solver", "dtype"), solvers("newton", "scipy", "adam", compiled=("lbfgsb", "projected")), indirect=["dtype"]
)
def test_every_solver_meets_the_target(solver, dtype):
    start = {"alpha": jnp.asarray(3.0, dtype), "gamma": jnp.asarray(0.5, dtype)}
    fitted = se.fit_contrast(shaded, 0.25, start, mask=MASK, bounds=BOUNDS, solver=solver)
    assert fitted.converged
    assert contrast_of(shaded(fitted.parameters)) == pytest.approx(0.25, rel=1.1e-4)


def test_a_solver_can_be_handed_in():
    seen = {}

    def solver(fun, start, bounds, *arguments):
        seen.update(start=start, bounds=bounds, arguments=arguments)
        u = start
        for _ in range(60):
            u = jnp.clip(u - 0.02 * jax.grad(fun)(u, *arguments), *bounds)
        return u

    render = lambda alpha, factor: factor * of_alpha(alpha)  # noqa: E731
    fitted = se.fit_contrast(render, 0.2, 30.0, mask=MASK, bounds=(0.0, 100.0), solver=solver, arguments=(2.0,))
    assert fitted.converged
    assert seen["arguments"] == (2.0,)
    np.testing.assert_allclose(seen["start"], [0.3], rtol=1e-6)
    np.testing.assert_array_equal(seen["bounds"], [[0.0], [1.0]])
    assert fitted.renders > 60


def test_a_measure_can_be_handed_in():
    def spread(image, mask):
        return jnp.max(jnp.where(mask, image, 0))

    fitted = se.fit_contrast(of_alpha, 0.7, 10.0, mask=MASK, bounds=(0.0, 100.0), measure=spread)
    assert spread(of_alpha(fitted.parameters), MASK) == pytest.approx(0.7, rel=1.1e-4)


def test_renders_are_counted():
    calls = []

    def render(alpha):
        calls.append(alpha)
        return waving(alpha)

    fitted = se.fit_contrast(render, 0.36, 70.0, mask=MASK, bounds=(0.0, 100.0))
    assert fitted.renders == len(calls)
    assert 0 < fitted.steps < fitted.renders


def test_solvers_that_compile_their_loop_are_counted_too():
    calls = []

    def render(alpha):
        jax.debug.callback(lambda a: calls.append(float(a)), alpha)
        return of_alpha(alpha)

    fitted = se.fit_contrast(render, 0.2, 30.0, mask=MASK, bounds=(0.0, 100.0), solver="projected")
    jax.effects_barrier()
    assert fitted.converged
    assert fitted.renders == len(calls) > 4


def test_a_target_out_of_reach_names_the_range():
    with pytest.raises(
        ValueError, match=r"target is 3; accepted are .* within the bounds, ([\d.e-]+) to ([\d.]+)"
    ) as e:
        se.fit_contrast(of_alpha, 3.0, 10.0, mask=MASK, bounds=(5.0, 100.0))
    low, high = (float(word) for word in str(e.value).split("bounds, ")[1].split(" (")[0].split(" to "))
    assert low == pytest.approx(contrast_of(of_alpha(5.0)), rel=1e-3)
    assert high == pytest.approx(contrast_of(of_alpha(100.0)), rel=1e-3)
    alphas = np.linspace(0, 100, 2001)
    values = [contrast_of(waving(a)) for a in alphas[::4]]
    with pytest.raises(ValueError, match=r"0\.01; accepted are") as e:
        se.fit_contrast(waving, 0.01, 10.0, mask=MASK, bounds=(0.0, 100.0))
    low, high = (float(word) for word in str(e.value).split("bounds, ")[1].split(" (")[0].split(" to "))
    assert low == pytest.approx(min(values), rel=0.01)
    assert high == pytest.approx(max(values), rel=0.01)


@pytest.mark.parametrize("start", [0.0, 0.31, 1.0])
@pytest.mark.parametrize("target", [0.36, 0.12])
def test_a_narrow_peak_or_dip_is_found(start, target):
    """Between the points of a survey, and so narrow that no climb from any of them sees it."""

    def peaked(x):
        return (
            1
            + (0.5 + 0.3 * jnp.exp(-jnp.square((x - 0.81) / 0.01)) - 0.4 * jnp.exp(-jnp.square((x - 0.57) / 0.01)))
            * HEIGHT
        )

    fitted = se.fit_contrast(peaked, target, start, mask=MASK, bounds=(0.0, 1.0))
    assert fitted.converged
    assert contrast_of(peaked(fitted.parameters)) == pytest.approx(target, rel=1.1e-4)


@pytest.mark.parametrize("start", [(0.6, 0.5), (0.0, 0.0), (1.0, 1.0)])
def test_a_dip_of_two_parameters_beside_a_flat_bound_is_found(start):
    """As of a faceted object, whose contrast is least at a strength far below the first point of a survey."""

    def render(p):
        x, y = p["x"], p["y"]
        return 1 + (0.5 + 0.3 * x / (x + 0.05) * (1.2 - y) - 1.5 * x * y * jnp.exp(-x / 0.02)) * HEIGHT * 0.6

    mesh = [contrast_of(render({"x": x, "y": y})) for x in np.linspace(0, 0.1, 41) for y in (0.9, 0.95, 1.0)]
    target = min(mesh) + 0.02 * (contrast_of(render({"x": 0.0, "y": 0.0})) - min(mesh))
    fitted = se.fit_contrast(
        render, target, dict(zip("xy", start, strict=True)), mask=MASK, bounds={"x": (0.0, 1.0), "y": (0.0, 1.0)}
    )
    assert fitted.converged


def test_a_jump_across_the_target_is_not_converged():
    def jumping(alpha):
        return 1 + jnp.where(alpha > 30.7, 0.5, 0.1) * HEIGHT

    fitted = se.fit_contrast(jumping, 0.2, 10.0, mask=MASK, bounds=(0.0, 100.0))
    assert fitted.converged is False
    assert fitted.renders < 100
    low, high = (contrast_of(jumping(a)) for a in (30.7, 30.71))
    assert fitted.reason == f"the contrast jumps across the target, from {low:.6g} to {high:.6g}"


def test_a_spent_budget_is_not_converged():
    fitted = se.fit_contrast(waving, 0.36, 70.0, mask=MASK, bounds=(0.0, 100.0), max_renders=2)
    assert fitted.converged is False
    assert fitted.renders == 2
    assert fitted.reason == "max_renders = 2 pictures did not do"
    found = se.fit_image(waving, waving(33.0), 70.0, mask=MASK, bounds=(0.0, 100.0), max_renders=2)
    assert found.converged is False
    assert found.reason == fitted.reason


def test_a_strength_map_moves_as_little_as_it_can(x64):
    strength = jnp.full(HEIGHT.shape, 10.0)
    fitted = se.fit_contrast(of_alpha, 0.25, strength, mask=MASK, bounds=(0.0, 40.0))
    assert fitted.converged
    assert fitted.renders <= 10
    assert np.all(fitted.parameters[~MASK] == 10)  # what the contrast does not depend on stays
    assert len(np.unique(fitted.parameters[MASK])) > 100


# ------------------------------------------------------------------------------------------- parameters and bounds


def test_records_dicts_and_numbers(dtype):
    def render(warp):
        return shaded({"alpha": jnp.asarray(warp.alpha, dtype), "gamma": jnp.asarray(warp.gamma, dtype)})

    start = se.LightWarp(alpha=jnp.asarray(5.0, dtype), gamma=jnp.asarray(0.1, dtype))
    fitted = se.fit_contrast(render, 0.25, start, mask=MASK, bounds={"alpha": (0, 100)})
    assert isinstance(fitted.parameters, se.LightWarp)
    assert fitted.parameters.gamma == start.gamma  # not named: held
    both = se.fit_contrast(render, 0.25, start, mask=MASK, bounds=(se.LightWarp(0, -1), se.LightWarp(100, 1)))
    named = se.fit_contrast(render, 0.25, start, mask=MASK, bounds={"alpha": (0, 100), "gamma": (-1, 1)})
    assert both.parameters.gamma != start.gamma
    assert (both.parameters.alpha, both.parameters.gamma) == (named.parameters.alpha, named.parameters.gamma)


def test_the_box_is_exact_at_its_ends_and_nested_bounds_hold_the_rest():
    lights = se.Lights(jnp.eye(3), jnp.ones((3, 3)))
    tree = {"lights": lights, "alpha": 0.1, "count": 3}
    box = Box(tree, {"lights": {"radiance": (0.3, np.full((3, 3), 1.7))}, "alpha": (0.1, 0.7)})
    assert box.size == 10
    for corner, alpha, radiance in ((0.0, 0.1, 0.3), (1.0, 0.7, 1.7)):
        at = box.parameters(np.full(10, corner))
        assert at["alpha"] == np.float32(alpha)
        assert np.all(at["lights"].radiance == np.float32(radiance))
    again = box.parameters(box.start)
    np.testing.assert_allclose(again["lights"].radiance, lights.radiance, rtol=1e-6)
    assert again["lights"].direction is lights.direction
    assert again["count"] == 3


def test_shortest_step_fills_what_bounds_leave(rng):
    for _ in range(50):
        u, slope = rng.random(6), rng.normal(size=6)
        change = rng.normal() * 2
        step = shortest_step(u, slope, change)
        assert np.all((u + step >= -1e-15) & (u + step <= 1 + 1e-15))
        most = (
            np.sum(np.maximum(slope * (1 - u), -slope * u))
            if change > 0
            else np.sum(np.minimum(slope * (1 - u), -slope * u))
        )
        assert slope @ step == pytest.approx(change if abs(change) < abs(most) else most, abs=1e-9)
    np.testing.assert_allclose(shortest_step(np.array([0.5, 0.5]), np.array([3.0, 4.0]), 1.0), [0.12, 0.16])


def test_survey_points_fill_the_cube():
    np.testing.assert_allclose(survey_points(1)[:, 0], [0, 1, 0.5, 0.25, 0.75, 0.125, 0.625, 0.375, 0.875])
    for dimensions in (2, 5, 16):
        points = survey_points(dimensions)[2:]
        assert points.shape[1] == dimensions
        assert np.all((points > 0) & (points < 1))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"target": np.nan}, "target is nan"),
        ({"target": 0.0}, "target is 0"),
        ({"target": -1.0}, "target is -1"),
        ({"target": np.ones(2)}, "target has shape"),
        ({"parameters": 120.0}, r"parameters starts at 120; accepted are values within its bounds \[0, 100\]"),
        ({"parameters": np.nan}, "parameters starts at nan"),
        ({"parameters": "ten"}, "parameters is 'ten'"),
        ({"parameters": ()}, "bounds name no parameter"),
        ({"parameters": np.zeros(0)}, "parameters hold no number"),
        ({"parameters": {"alpha": 120.0}, "bounds": {"alpha": (0, 100)}}, r"parameters\['alpha'\] starts at 120"),
        ({"parameters": {"alpha": 1.0}, "bounds": {"beta": (0, 100)}}, "bounds names 'beta'; accepted .* 'alpha'"),
        ({"parameters": {"alpha": 1.0}, "bounds": {}}, "bounds name no parameter"),
        ({"parameters": {"alpha": 1.0}, "bounds": {"alpha": 5.0}}, r"bounds\['alpha'\] is 5.0"),
        ({"parameters": {"alpha": 1.0}, "bounds": ({"b": 0.0}, {"b": 1.0})}, "bounds has the structure"),
        ({"bounds": {"alpha": (0, 100)}}, "bounds is a dict, but the parameters are a float"),
        ({"bounds": (100.0, 0.0)}, r"bounds of parameters are \[100, 0\]; accepted is lower < upper"),
        ({"bounds": (10.0, 10.0)}, "accepted is lower < upper"),
        ({"bounds": (0.0, np.inf)}, "not finite"),
        ({"bounds": (0.0, np.ones(3))}, "have shapes"),
        ({"bounds": 5.0}, "bounds is 5.0"),
        ({"measure": "weber"}, "measure is 'weber'"),
        ({"solver": "simplex"}, "solver is 'simplex'"),
        ({"mask": np.zeros_like(MASK)}, "mask is empty"),
        ({"mask": MASK[0]}, "mask has shape"),
        ({"mask": MASK[1:]}, "render gives an image of shape"),
        ({"arguments": 3.0}, "arguments is a float"),
        ({"tolerance": 0.0}, "tolerance is 0"),
        ({"max_renders": 1}, "max_renders is 1"),
        ({"measure": lambda image, mask: jnp.nan * image[0, 0]}, "measure is nan"),
    ],
)
def test_fit_contrast_names_bad_input(change, words):
    given = {"target": 0.25, "parameters": 10.0, "mask": MASK, "bounds": (0.0, 100.0)} | change
    target, parameters = given.pop("target"), given.pop("parameters")
    with pytest.raises(ValueError, match=words):
        se.fit_contrast(of_alpha, target, parameters, **given)


def test_traced_values_are_refused_where_they_cannot_be_used():
    fit = lambda target: se.fit_contrast(of_alpha, target, 10.0, mask=MASK, bounds=(0.0, 100.0)).parameters  # noqa: E731
    with pytest.raises(ValueError, match="traced by jit or vmap"):
        jax.jit(fit)(0.25)
    with pytest.raises(ValueError, match="traced by jit or vmap"):
        jax.vmap(fit)(jnp.array([0.2, 0.25]))
    with pytest.raises(ValueError, match="parameters are traced"):
        jax.grad(lambda a: se.fit_contrast(of_alpha, 0.25, a, mask=MASK, bounds=(0.0, 100.0)).parameters)(10.0)
    with pytest.raises(ValueError, match="arguments="):
        jax.grad(lambda k: se.fit_contrast(lambda a: waving(a) + k, 0.25, 9.0, mask=MASK, bounds=(0, 100)).parameters)(
            0.1
        )


# ------------------------------------------------------------------------------------------- through the fit

EXACT = {"mask": MASK, "tolerance": 1e-12}


@pytest.mark.parametrize(
    ("measure", "transform"),
    [("rms", jax.grad), ("michelson", jax.grad), ("band", jax.grad), ("rms", jax.jacfwd), ("rms", jax.jacrev)],
)
def test_the_parameter_follows_the_target(measure, transform, x64):
    target = {"rms": 0.25, "michelson": 0.3, "band": 0.05}[measure]
    fit = lambda t: se.fit_contrast(of_alpha, t, 10.0, bounds=(0, 100), measure=measure, **EXACT).parameters  # noqa: E731
    difference = (fit(target * (1 + 1e-5)) - fit(target * (1 - 1e-5))) / (2e-5 * target)
    assert transform(fit)(target) == pytest.approx(float(difference), rel=1e-6)


def test_the_parameter_follows_the_arguments(x64):
    """What the same contrast takes when something else in the picture changes."""

    def render(alpha, scene):
        return shaded({"alpha": alpha, "gamma": scene["gamma"]}) + scene["haze"]

    def fit(haze):
        scene = {"gamma": 0.1, "haze": haze, "label": 3}
        return se.fit_contrast(render, 0.25, 10.0, bounds=(0, 100), arguments=(scene,), **EXACT).parameters

    difference = (fit(0.05 + 1e-6) - fit(0.05 - 1e-6)) / 2e-6
    assert difference > 10
    assert jax.grad(fit)(0.05) == pytest.approx(float(difference), rel=1e-6)


def test_several_parameters_follow_the_target_by_the_shortest_change(x64):
    start = {"alpha": 8.0, "gamma": 0.1}

    def fit(target, begin):
        return se.fit_contrast(shaded, target, begin, bounds=BOUNDS, **EXACT).parameters

    found = jax.tree.map(float, fit(0.25, start))
    slope = jax.jacrev(lambda t: fit(t, start))(0.25)
    for name in start:
        difference = (fit(0.25 + 1e-6, found)[name] - fit(0.25 - 1e-6, found)[name]) / 2e-6
        assert slope[name] == pytest.approx(float(difference), rel=1e-4)


def test_a_parameter_at_its_bound_stays_there(x64):
    start, bounds = {"alpha": 20.0, "gamma": 0.8}, {"alpha": (0, 100), "gamma": (-1, 0.9)}
    fit = lambda t: se.fit_contrast(shaded, t, start, bounds=bounds, **EXACT).parameters  # noqa: E731
    target = contrast_of(shaded({"alpha": 40.0, "gamma": 0.9}))
    assert fit(target)["gamma"] == 0.9
    slope = jax.jacrev(fit)(target)
    assert slope["gamma"] == 0
    difference = (fit(target + 1e-6)["alpha"] - fit(target - 1e-6)["alpha"]) / 2e-6
    assert slope["alpha"] == pytest.approx(float(difference), rel=1e-5)


def test_the_second_derivative_exists_too(x64):
    fit = lambda t: se.fit_contrast(of_alpha, t, 10.0, bounds=(0, 100), **EXACT).parameters  # noqa: E731
    slope = jax.grad(fit)
    difference = (slope(0.25 + 1e-5) - slope(0.25 - 1e-5)) / 2e-5
    assert jax.grad(slope)(0.25) == pytest.approx(float(difference), rel=1e-5)


# ------------------------------------------------------------------------------------------- fit_image

HIDDEN = {"alpha": 33.0, "gamma": 0.3}


def hidden_picture(dtype):
    return shaded({name: jnp.asarray(value, dtype) for name, value in HIDDEN.items()})


@pytest.mark.parametrize(
    ("solver", "dtype"),
    [
        *solvers("scipy", "adam", compiled=("projected",)),
        *(pytest.param("lbfgsb", dtype, marks=pytest.mark.thorough) for dtype in ("float32", "float64")),
    ],
    indirect=["dtype"],
)
def test_hidden_parameters_are_recovered_from_their_picture(solver, dtype):
    start = {"alpha": jnp.asarray(5.0, dtype), "gamma": jnp.asarray(-0.2, dtype)}
    found = se.fit_image(shaded, hidden_picture(dtype), start, mask=MASK, bounds=BOUNDS, solver=solver)
    assert found.value < 1e-4
    for name, value in HIDDEN.items():
        assert found.parameters[name].dtype == dtype
        assert found.parameters[name] == pytest.approx(value, rel=2e-3)


def test_pixels_that_are_not_finite_do_not_count(dtype):
    picture = np.array(hidden_picture(dtype))
    picture[10, 12], picture[11, 11] = np.nan, np.inf
    picture[~MASK] = 1e9
    start = {"alpha": jnp.asarray(5.0, dtype), "gamma": jnp.asarray(-0.2, dtype)}
    found = se.fit_image(shaded, picture, start, mask=MASK, bounds=BOUNDS)
    assert found.converged is True
    assert found.parameters["alpha"] == pytest.approx(33, rel=1e-3)


def test_a_picture_without_finite_pixels_is_no_match():
    picture = hidden_picture(np.dtype("float32"))
    start = {"alpha": 60.0, "gamma": 0.0}
    with pytest.raises(ValueError, match="reference has no finite pixel under the mask; accepted"):
        se.fit_image(shaded, np.nan * picture, start, mask=MASK, bounds=BOUNDS)
    absent = lambda p: jnp.where(p["alpha"] > -50, np.nan, shaded(p))  # noqa: E731
    for fit, wanted in ((se.fit_image, picture), (se.fit_contrast, 0.25)):
        with pytest.raises(ValueError, match="render gives no finite pixel under the mask; accepted"):
            fit(absent, wanted, start, mask=MASK, bounds=BOUNDS)
    with pytest.raises(ValueError, match="gradient of the picture's measure is not finite; accepted"):
        se.fit_contrast(lambda p: shaded(p) + jnp.sqrt(0 * p["alpha"]), 0.25, start, mask=MASK, bounds=BOUNDS)


def test_pixels_that_a_rendered_picture_lacks_are_no_match(x64):
    """Else a fit would be best off where it shows least."""
    alike = np.indices(MASK.shape)[1] < 12
    render = lambda a: jnp.where(alike, 1.0, jnp.where(a > 60, jnp.nan, of_alpha(a)))  # noqa: E731
    found = se.fit_image(render, render(33.0), 70.0, mask=MASK, bounds=(0.0, 100.0), starts=9)
    assert found.converged
    assert found.parameters == pytest.approx(33, rel=1e-3)


def test_a_picture_that_cannot_be_matched_gives_the_nearest(x64, rng):
    """Least squares: at the minimum no parameter changes the difference."""
    picture = np.array(hidden_picture(x64)) + 0.02 * rng.normal(size=HEIGHT.shape)
    found = se.fit_image(shaded, picture, {"alpha": 5.0, "gamma": 0.0}, mask=MASK, bounds=BOUNDS, tolerance=1e-7)
    assert found.converged
    power = np.sum(picture[MASK] ** 2)
    difference = lambda p: jnp.sum(((shaded(p) - picture)[MASK]) ** 2) / power  # noqa: E731
    assert found.value == pytest.approx(float(jnp.sqrt(difference(found.parameters))), rel=1e-9)
    slope = jax.grad(difference)(found.parameters)
    assert abs(slope["alpha"]) * 140 < 1e-5
    assert abs(slope["gamma"]) * 2 < 1e-5


def test_more_starts_escape_a_local_minimum(x64):
    render = lambda phase: 2 + jnp.sin(phase * (1 + HEIGHT))  # noqa: E731
    picture = render(15.0)
    once = se.fit_image(render, picture, 3.0, mask=MASK, bounds=(0.0, 20.0))
    often = se.fit_image(render, picture, 3.0, mask=MASK, bounds=(0.0, 20.0), starts=9)
    assert once.value > 0.01
    assert often.converged
    assert often.parameters == pytest.approx(15, rel=1e-4)


@pytest.mark.parametrize("solver", ["scipy", "adam"])
def test_a_strength_map_is_recovered(solver, dtype):
    y = np.mgrid[0:24, 0:30][0] / 24
    hidden = jnp.asarray(5 + 10 * y, dtype)
    where = MASK & (abs(HEIGHT) > 0.2)
    start = jnp.full(HEIGHT.shape, 10.0, dtype)
    found = se.fit_image(of_alpha, of_alpha(hidden), start, mask=where, bounds=(0, 40), solver=solver, tolerance=1e-4)
    assert found.value <= 1e-4
    np.testing.assert_allclose(found.parameters[where], hidden[where], atol=0.2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"reference": np.zeros((3, 3))}, "reference has shape"),
        ({"reference": np.zeros((*MASK.shape, 3))}, "render gives an image of shape"),
        ({"solver": "newton"}, "solver is 'newton'"),
        ({"starts": 0}, "starts is 0"),
        ({"mask": np.zeros_like(MASK)}, "mask is empty"),
        ({"parameters": 300.0}, "starts at 300"),
        ({"tolerance": 2.0}, "tolerance is 2"),
    ],
)
def test_fit_image_names_bad_input(change, words):
    given = {"reference": np.ones(MASK.shape), "parameters": 10.0, "mask": MASK, "bounds": (0.0, 100.0)} | change
    reference, parameters = given.pop("reference"), given.pop("parameters")
    with pytest.raises(ValueError, match=words):
        se.fit_image(of_alpha, reference, parameters, **given)


# ------------------------------------------------------------------------------------------- import


def test_importing_the_package_loads_no_solver_and_warns_of_nothing():
    code = "import sys, shapeenh; print(sorted({'jaxopt', 'optax'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr


# ------------------------------------------------------------------------------------------- command line


def test_shapeenh_fit_finds_draws_and_prints(tmp_path, capsys):
    small = ["--size", "64x48", "--lights", "8", "--samples", "1", "-o", str(tmp_path / "o.png")]
    assert main(["fit", "--target-contrast", "0.82", "--fit", "gamma", "--json", *small]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["alpha"] == 30  # held
    assert found["contrast"] == pytest.approx(0.82, rel=1e-3)
    assert found["converged"] is True
    picture = se.load_image(tmp_path / "o.png")
    assert picture.shape == (48, 128, 3)
    assert np.abs(picture[:, :64].astype(int) - picture[:, 64:]).max() > 5

    knot = se.carved_knot()  # the same, by hand
    gbuffer = se.render_gbuffer(
        knot,
        camera := se.frame_mesh(knot, direction=(0.33036, 0.258819, 0.907673), fov_degrees=30, aspect=4 / 3),
        height=48,
        width=64,
    )
    lights = se.rotate_lights(se.sample_environment(se.procedural_studio(), 8), camera)
    warp = se.LightWarp(30.0, found["gamma"])
    image = se.enhance(gbuffer, lights, se.named_material("stone"), warp, sigma=2.0, creases=70.0)
    assert se.contrast(image, gbuffer.mask) == pytest.approx(0.82, rel=2e-3)

    assert main(["fit", "--target-contrast", "0.82", *small]) == 0
    assert re.match(r"alpha [\d.]+, gamma [\d.-]+: rms contrast 0\.82", capsys.readouterr().out)


def test_shapeenh_fit_says_why_it_did_not_converge(capsys):
    stopped = se.FitResult(se.LightWarp(3.0, 0.0), jnp.asarray(0.7), 4, 9, False, "the contrast jumps")
    report(argparse.Namespace(json=False, measure="rms"), stopped, 0.5)
    assert "(not converged: the contrast jumps)" in capsys.readouterr().out
    report(argparse.Namespace(json=True, measure="rms"), stopped, 0.5)
    assert json.loads(capsys.readouterr().out)["reason"] == "the contrast jumps"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--target-contrast", "-1"], "--target-contrast is -1"),
        (["--target-contrast", "9"], "accepted are the contrasts that can be reached"),
        (["--target-contrast", "0.5", "--alpha", "300"], "--alpha is 300"),
        (["--target-contrast", "0.5", "--measure", "weber"], "weber"),
        ([], "--target-contrast"),
    ],
)
def test_shapeenh_fit_names_bad_input(options, words, tmp_path, capsys):
    small = ["--size", "64x48", "--lights", "8", "--samples", "1", "-o", str(tmp_path / "o.png")]
    assert main(["fit", *options, *small]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "o.png").exists()
