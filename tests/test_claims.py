"""Every claim of `claims.py` on every scene, in float64: gradients against differences and by a Taylor remainder; and
every absence of `absences.py`, where a difference sees what the derivative does not."""

import collections
import functools
import re
import zlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from shapeenh.descriptor.diffusion import levels_for
from tests.absences import ABSENCES, NOT_NUMERIC
from tests.claims import CLAIMS
from tests.programs import Counted
from tests.scenes import SCENES, SIZE, make_scene

# The maths is tested here, not what the compiler makes of it: without LLVM's passes it compiles a third faster.
FAST = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
STEPS = 10.0 ** -np.arange(1, 8.01, 0.5)
DECADE = 3  # samples of a decade, both ends
SMALL = 4  # from here on steps are small enough for a central difference
ROUNDING = 1e-13  # of a sum of about a thousand terms, relative to their size


@functools.cache
def scenes():
    with jax.enable_x64(True):
        return {kind: make_scene(kind) for kind in SCENES}


def reduced(claim):
    """(scalar, size): the outputs times fixed random weights, and the sum of the sizes of these terms."""

    def value(scene, values):
        leaves = [
            leaf
            for leaf in jax.tree.leaves(claim.call(scene, dict(values)))
            if jnp.issubdtype(leaf.dtype, jnp.floating)
        ]
        rng = np.random.default_rng(zlib.crc32(claim.id.encode()))
        terms = [rng.normal(size=leaf.shape) * leaf for leaf in leaves]
        return sum(jnp.sum(t) for t in terms), sum(jnp.sum(jnp.abs(t)) for t in terms)

    return value


def direction(name, value, seed):
    """A random direction, in units of the value's own size; images do not move off the mask, where they are 0."""
    rng = np.random.default_rng([zlib.crc32(name.encode()), seed])
    v = rng.normal(size=np.shape(value)) * np.sqrt(np.mean(np.square(value)))
    return np.where(value == 0, 0, v) if np.shape(value)[:2] == SIZE else v


def taylor_slope(remainders, floor):
    """The slope of the remainder over the best decade that lies above rounding; None where none does."""
    slopes = []
    for i in range(len(STEPS) - DECADE + 1):
        part = remainders[i : i + DECADE]
        if np.all(np.isfinite(part)) and np.all(part > 10 * floor):
            slopes.append(np.polyfit(np.log10(STEPS[i : i + DECADE]), np.log10(part), 1)[0])
    return max(slopes) if slopes else None


def check(claim, value, gradient_of, scene, kind, moved):
    values = {name: np.asarray(x) for name, x in claim.values(scene).items()}
    (f0, size), gradient = gradient_of(scene, values)
    f0, failures = float(f0), []
    floor = ROUNDING * (float(size) + 1e-3)
    for name, x in values.items():
        g = np.asarray(gradient[name])
        assert np.all(np.isfinite(g)), f"{kind}: gradient in {name} is not finite"
        v = direction(f"{claim.id} {name}", x, SCENES.index(kind))
        slope = float(np.sum(g * v))
        along = lambda h: float(value(scene, values | {name: x + h * v})[0])  # noqa: B023, E731
        ahead = np.array([along(h) for h in STEPS])
        remainder = np.abs(ahead - f0 - STEPS * slope)
        taylor = taylor_slope(remainder, floor)
        linear = np.all(remainder[STEPS < 2e-4] <= 10 * floor)
        errors = [abs((ahead[i] - along(-STEPS[i])) / (2 * STEPS[i]) - slope) for i in range(SMALL, len(STEPS), 2)]
        scale = np.sqrt(np.sum(np.square(g * v)))
        moved[name] |= bool(scale > 0)
        if not (linear or (taylor is not None and taylor >= 1.9)):
            failures.append(
                f"{name}: Taylor {taylor}, remainders {remainder[::2]}, floor {floor:.1e}, slope {slope:.3g}"
            )
        if min(errors) > 1e-6 * (abs(slope) + scale) + floor / STEPS[SMALL]:
            failures.append(f"{name}: slope {slope}, errors {errors}, scale {scale}")
    assert not failures, f"{kind}: " + "\n".join(failures)


def tier(entry):
    """What compiles long runs before a release; the whole chain in CI."""
    return pytest.mark.slow if entry.id == "render" else pytest.mark.thorough


def entries(table):
    return {
        "argvalues": [pytest.param(e, marks=tier(e)) if e.slow else e for e in table],
        "ids": lambda e: e.id,
    }


@pytest.mark.parametrize("claim", **entries(CLAIMS))
def test_gradients_are_what_the_table_claims(claim, x64):
    value = reduced(claim)
    compiled = Counted(value, compiler_options=FAST)
    gradient = Counted(jax.value_and_grad(value, argnums=1, has_aux=True), compiler_options=FAST)
    moved = collections.defaultdict(bool)
    for kind, scene in scenes().items():
        check(claim, compiled, gradient, scene, kind, moved)
    assert all(moved.values()), f"gradients that are 0 on every scene: {moved}"
    assert compiled.traces == gradient.traces == 1  # one program for all scenes and steps


# ------------------------------------------------------------------------------------------- absences


@pytest.mark.parametrize("absence", **entries(ABSENCES))
def test_stated_absences_are_there_and_hide_a_change(absence, x64):
    scene = scenes()["torus"]
    at, step = (np.asarray(f(scene), np.float64) for f in (absence.at, absence.step))
    rng = np.random.default_rng(7)
    shapes = []

    def value(scene, x):
        leaves = [a for a in jax.tree.leaves(absence.call(scene, x)) if jnp.issubdtype(a.dtype, jnp.floating)]
        shapes[:] = shapes or [rng.uniform(0.5, 1.5, a.shape) for a in leaves]
        return sum(jnp.sum(w * a) for w, a in zip(shapes, leaves, strict=True))

    if absence.kind == "refused":
        with pytest.raises((ValueError, jax.errors.TracerArrayConversionError)):
            jax.grad(value, argnums=1)(scene, at)
        return
    both = jax.jit(jax.value_and_grad(value, argnums=1), compiler_options=FAST)
    before, gradient = both(scene, at)
    after, _ = both(scene, at + step)
    assert np.all(np.isfinite(gradient))
    if absence.kind == "zero":
        assert np.max(np.abs(gradient)) <= 1e-15 * abs(float(after - before))  # nothing but rounding
    assert abs(float(after - before)) > 1e-3 * np.max(np.abs(step))


def test_lights_of_a_map_move_with_their_cells_fixed_and_jump_where_cells_change(x64):
    """`sample_environment`: along a path from one map to another the partition changes, and the derivative is blind."""
    first, second = (scenes()[kind].map for kind in ("torus", "rough"))

    weights = jnp.arange(15.0).reshape(5, 3)

    @jax.jit
    def lights(t):
        return jnp.sum(se.sample_environment((1 - t) * first + t * second, 5).direction * weights)

    slope = jax.grad(lights)
    ts = np.linspace(0, 1, 33)
    values = np.array([float(lights(t)) for t in ts])
    k = int(np.argmax(np.abs(np.diff(values))))
    low, high = ts[k], ts[k + 1]
    for _ in range(30):
        middle = 0.5 * (low + high)
        left = abs(lights(middle) - lights(low)) > abs(lights(high) - lights(middle))
        low, high = (low, middle) if left else (middle, high)
    assert abs(lights(high) - lights(low)) > 1e-2  # over a step of 1e-11
    assert abs(slope(low)) < 1e3
    assert abs(slope(high)) < 1e3


@pytest.mark.slow
def test_fast_diffusion_steps_where_a_coarser_grid_joins(x64):
    """`describe`: its value jumps at such a sigma, by no more than the scheme's error; explicit steps do not."""
    low, high = 2.0, 4.0
    first = levels_for(low)
    while high - low > 1e-12:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if levels_for(middle) == first else (low, middle)

    gbuffer = scenes()["torus"].gbuffer
    smoothed = lambda *how: np.asarray(se.describe(gbuffer, sigma=how[0], scheme=how[1]).gradient)  # noqa: E731
    below, above, exact = smoothed(low, "fast"), smoothed(high, "fast"), smoothed(high, "explicit")
    size = lambda a: np.sqrt(np.sum(a * a) / np.sum(exact * exact))  # noqa: E731
    assert size(above - below) > 1e-6
    assert size(above - below) <= 1.01 * (size(above - exact) + size(below - exact))
    assert size(smoothed(low, "explicit") - exact) < 1e-9


def test_the_fitted_parameter_moves_with_target_and_arguments(x64):
    """`fit_contrast`: implicit differentiation against refitting."""
    ramp = jnp.linspace(0.1, 1, 12).reshape(3, 4)

    def fitted(target, bend):
        render = lambda p, bend: ramp**p + 0.1 * bend * ramp  # noqa: E731
        result = se.fit_contrast(
            render, target, 1.0, mask=np.ones((3, 4), bool), bounds=(0.1, 5.0), arguments=(bend,), tolerance=1e-12
        )
        return result.parameters

    got = jax.grad(fitted, argnums=(0, 1))(0.6, 0.5)
    h = 1e-5
    np.testing.assert_allclose(got[0], (fitted(0.6 + h, 0.5) - fitted(0.6 - h, 0.5)) / (2 * h), rtol=1e-6)
    np.testing.assert_allclose(got[1], (fitted(0.6, 0.5 + h) - fitted(0.6, 0.5 - h)) / (2 * h), rtol=1e-6)


# ------------------------------------------------------------------------------------------- reverse mode only

PAGE = (Path(__file__).parent.parent / "docs" / "gradients.md").read_text()


def rows_of_the_page():
    """{function: what its row says}"""
    rows = re.findall(r"^\| (`[a-z_`, ]+`) \| (.*) \|$", PAGE, flags=re.MULTILINE)
    return {name: text for names, text in rows for name in re.findall(r"`(\w+)`", names)}


@pytest.mark.slow
@pytest.mark.parametrize("name", dict.fromkeys(c.name for c in CLAIMS))
def test_forward_mode_is_refused_where_the_page_says_so(name, x64):
    scene, refused = scenes()["torus"], False
    for claim in (c for c in CLAIMS if c.name == name):

        def floats(v, claim=claim):
            return [a for a in jax.tree.leaves(claim.call(scene, v)) if jnp.issubdtype(a.dtype, jnp.floating)]

        values = {k: jnp.asarray(x) for k, x in claim.values(scene).items()}
        try:
            jax.jit(lambda v, floats=floats: jax.jvp(floats, (v,), (v,))).lower(values)
        except TypeError:
            refused = True
    assert refused == ("reverse mode only" in rows_of_the_page()[name])


# ------------------------------------------------------------------------------------------- completeness

HERE = {"fit_contrast"}  # claimed by a test of its own above: it runs on the host


def test_every_public_name_claims_a_gradient_or_says_why_not():
    claimed = {c.name for c in CLAIMS} | HERE
    absent = {a.name for a in ABSENCES}
    other = {name for names in NOT_NUMERIC.values() for name in names.split()}
    assert claimed | absent | other == set(se.__all__)
    assert not other & (claimed | absent)


def test_the_page_on_gradients_names_the_same_functions():
    assert set(rows_of_the_page()) == {c.name for c in CLAIMS} | {a.name for a in ABSENCES} | HERE
