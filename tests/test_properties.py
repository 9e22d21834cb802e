"""Hostile inputs to every function that makes pictures: valid pixels and gradients stay finite, bad pixels stay alone.

Everything is passed as arguments of one compiled function per stage and shape, value and gradient in one, so that the
general variants are tested and nothing compiles again from example to example.
"""

import dataclasses
import functools
import zlib

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from tests import hostile
from tests.programs import Counted

SHAPE = 9, 11
TINY = (1, 1), (1, 7), (6, 1)
FIELDS = "depth", "normal", "position", "albedo", "occlusion"


# ------------------------------------------------------------------------------------------- the stages


def gbuffer(i):
    return se.GBuffer(i["mask"], **{name: i[name] for name in FIELDS})


def descriptor(i):
    rest = i["silhouette"], 0 * i["silhouette"], 1 - i["silhouette"]
    return se.Descriptor(i["hessian"], i["gradient"], *rest)


def field(i):
    return se.LineField(i["height"], i["direction"], i["singularity"])


def profile(i):
    distance = jnp.where(i["mask"], i["noise"][..., 0], 0)
    return se.Profile(distance, i["noise"][..., 1], -i["noise"][..., 2], i["mask"])


def material(p):
    return se.Material(p["diffuse"], p["specular"], p["shininess"])


LOOK = ("alpha", "gamma", "contrast", "invariant", "anisotropy", "concave")
STAGES = {}


def stage(function, kind="pixels", slow=False):
    """`function(i, p)` of images and parameters. `kind`: "pixels", each pixel for itself; "neighbours", of a bad normal
    they see what they see of the background; "image" and "input", all else."""
    STAGES[function.__name__] = pytest.param(function, kind, id=function.__name__, marks=[pytest.mark.thorough] * slow)
    return function


def look(p, *names):
    return {name: p[name] for name in names}


@functools.partial(stage, kind="neighbours", slow=True)
def describe(i, p):
    return se.describe(gbuffer(i), sigma=p["sigma"], foreshortening=p["f"], creases=60.0)


@functools.partial(stage, kind="neighbours")
def describe_unsmoothed(i, p):
    return se.describe(gbuffer(i))


@functools.partial(stage, kind="neighbours", slow=True)
def describe_object(i, p):
    return se.describe_object(gbuffer(i), i["tensor"], p["camera"])


@functools.partial(stage, kind="neighbours")
def describe_apparent(i, p):
    return se.describe_apparent(gbuffer(i))


@functools.partial(stage, kind="neighbours", slow=True)
def describe_relief(i, p):
    return se.describe_relief(gbuffer(i), sigma=p["sigma"] + 0.5, beta=p["beta"], base=descriptor(i)).hessian


@stage
def curvature_colors(i, p):
    return se.curvature_colors(descriptor(i), i["mask"])


@stage
def shade(i, p):
    return se.shade(gbuffer(i), p["lights"], material(p))


@stage
def shade_warped(i, p):
    return se.shade_warped(
        gbuffer(i), descriptor(i), p["lights"], material(p), alpha=p["alpha"], gamma=p["contrast"], concave=p["concave"]
    )


@functools.partial(stage, slow=True)
def shade_scaled(i, p):
    return se.shade_scaled(
        gbuffer(i),
        descriptor(i),
        p["lights"],
        material(p),
        gamma_diffuse=p["gamma"],
        gamma_specular=p["gamma"],
        **look(p, "alpha", "contrast", "invariant", "anisotropy", "concave"),
    )


@stage
def shade_mirror(i, p):
    return se.shade_mirror(gbuffer(i), p["map"], descriptor=descriptor(i), **look(p, *LOOK))


@functools.partial(stage, slow=True)
def shade_refraction(i, p):
    return se.shade_refraction(gbuffer(i), p["map"], descriptor=descriptor(i), ior=p["ior"], **look(p, *LOOK))


@stage
def shade_diffuse(i, p):
    return se.shade_diffuse(gbuffer(i), p["harmonics"], descriptor=descriptor(i), **look(p, *LOOK))


@stage
def shade_forward(i, p):
    options = {"alpha": p["alpha"], "gamma": p["contrast"], "samples": 8}
    return se.shade_forward(gbuffer(i), descriptor(i), p["map"], material(p), **options)


@stage
def shade_phong(i, p):
    gammas = {f"gamma_{lobe}": p["gamma"] for lobe in ("ambient", "diffuse", "specular")}
    options = look(p, "alpha", "contrast", "invariant", "anisotropy", "concave", "shininess", "exponent")
    return se.shade_phong(gbuffer(i), p["lights"], descriptor=descriptor(i), **gammas, **options)


@functools.partial(stage, kind="image")
def ambient_occlusion(i, p):
    options = {"radius": 0.5, "directions": 8, "steps": 3}
    return se.ambient_occlusion(gbuffer(i), p["camera"], descriptor=descriptor(i), alpha=p["alpha"], **options)


@stage
def lit_sphere(i, p):
    return se.lit_sphere(gbuffer(i), p["map"], concave=p["map"], descriptor=descriptor(i), transition=p["alpha"])


@functools.partial(stage, kind="image")
def line_field_ridge(i, p):
    return se.line_field("ridge", gbuffer(i), descriptor(i), sigma=p["sigma"])


@functools.partial(stage, kind="image", slow=True)
def line_field_inflection(i, p):
    return se.line_field("inflection", gbuffer(i), descriptor(i), sigma=p["sigma"])


@functools.partial(stage, kind="image", slow=True)
def line_field_occlusion(i, p):
    return se.line_field("occlusion", gbuffer(i), descriptor(i), sigma=p["sigma"])


@functools.partial(stage, kind="image")
def make_line_field(i, p):
    return se.make_line_field(i["height"], i["direction"], mask=i["mask"], silhouette=i["silhouette"], sigma=p["sigma"])


@stage
def apply_texture(i, p):
    return se.apply_texture(dataclasses.replace(gbuffer(i), uv=i["gradient"]), p["map"]).albedo


@functools.partial(stage, kind="image", slow=True)
def enhance_warped(i, p):
    warp = se.LightWarp(p["alpha"], p["contrast"])
    return se.enhance(gbuffer(i), p["lights"], material(p), warp, sigma=p["sigma"], foreshortening=p["f"])


@functools.partial(stage, kind="image", slow=True)
def enhance_scaled(i, p):
    gamma = jnp.minimum(p["gamma"], 1e9)  # of 1e20 the derivative in the normals itself overflows, and in sigma
    scaling = se.RadianceScaling(p["invariant"], gamma, gamma, p["anisotropy"])
    return se.enhance(gbuffer(i), p["lights"], material(p), scaling, sigma=p["sigma"])


@functools.partial(stage, kind="image")
def fit_profile(i, p):
    return se.fit_profile(field(i), samples=5)


@functools.partial(stage, kind="image")
def draw_lines(i, p):
    brush = se.Brush(aspect=p["invariant"], shade=0.5, wobble=1.0, gaps=1.0, spread=1.0, grow=1.0)
    clean = se.LineField(i["height"], jnp.nan_to_num(i["direction"], posinf=0, neginf=0), i["singularity"])
    return se.draw_lines(profile(i), clean, brush, footprint="ellipse", shading=i["image"], noise=i["noise"], reach=2)


@functools.partial(stage, kind="image", slow=True)
def surface_noise(i, p):
    return se.surface_noise(gbuffer(i), p["camera"], size=p["ior"])


@functools.partial(stage, kind="image")
def contrast_rms(i, p):
    return se.contrast(i["image"], i["mask"])


@functools.partial(stage, kind="image")
def contrast_michelson(i, p):
    return se.contrast(i["image"], i["mask"], measure="michelson")


@functools.partial(stage, kind="image")
def contrast_band(i, p):
    return se.contrast(i["image"], i["mask"], measure="band", scale=1.0)


@functools.partial(stage, kind="input")
def gbuffer_from_normals(i, p):
    rest = {"depth": i["depth"], "mask": i["mask"], "occlusion": i["occlusion"], "albedo": i["albedo"]}
    return se.gbuffer_from_normals(i["normal"], **rest, spacing=p["ior"], check=False)


@functools.partial(stage, kind="input")
def gbuffer_from_height(i, p):
    rest = {"mask": i["mask"], "occlusion": i["occlusion"], "albedo": i["albedo"], "max_slope": p["shininess"] + 0.1}
    return se.gbuffer_from_height(i["height"], **rest, spacing=p["ior"], z_factor=p["ior"])


@functools.partial(stage, kind="input")
def decode_normals(i, p):
    return se.decode_normals(i["normal"])


# ------------------------------------------------------------------------------------------- examples


@functools.cache
def camera(dtype):
    made = se.perspective_camera((0.0, 0, 0), (0.0, 0, -3), fov_degrees=40.0, aspect=SHAPE[1] / SHAPE[0])
    return jax.tree.map(lambda a: np.asarray(a, dtype), made)


def parameters(draw, dtype):
    rng = np.random.default_rng(draw.seed + 1)
    pick = lambda *choices: choices[rng.integers(len(choices))]  # noqa: E731
    made = {
        "alpha": draw.alpha,
        "gamma": draw.gamma,
        "contrast": pick(-1.0, 0.0, 0.3, 1.0),
        "invariant": pick(1e-3, 0.5, 0.999),
        "anisotropy": pick(-1.0, 0.0, 1.0),
        "concave": pick(1.0, 0.0, 0.3) if abs(draw.alpha) < 1e30 else 1.0,  # at 0 the derivative itself overflows
        "sigma": pick(0.0, 1e-3, 0.7, 2.5),
        "f": pick(0.0, 0.3, 1.0, 4.0),
        "beta": pick(-20.0, 0.0, 20.0),
        "ior": pick(1.0, 1.5, 50.0),
        "exponent": pick(0.0, 0.3, 1.0),
        "diffuse": np.array(pick([0.0] * 3, [0.5, 0.6, 1.0])),
        "specular": np.array(pick([0.0] * 3, [0.04, 0.5, 1.0])),
        "shininess": pick(0.0, 1.0, 1e4),
        "map": rng.choice([0, 0.5, 1e4], size=(4, 8, 3)),
        "harmonics": rng.normal(size=(9, 3)),
        "lights": hostile.light_of(draw, rng),
    }
    return jax.tree.map(lambda a: np.asarray(a, dtype), made) | {"camera": camera(dtype)}


@functools.cache
def program(function, gradient: bool):
    """jit of ((value, outputs), gradients in every image and parameter), or of outputs alone."""

    def value(floats, mask, p):
        out = function(floats | {"mask": mask}, p)
        rng = np.random.default_rng(zlib.crc32(function.__name__.encode()))
        leaves = [leaf for leaf in jax.tree.leaves(out) if hostile.is_float(leaf)]
        return sum(jnp.sum(rng.uniform(0.1, 1, leaf.shape).astype(leaf.dtype) * leaf) for leaf in leaves), out

    if gradient:
        return Counted(jax.value_and_grad(value, argnums=(0, 2), has_aux=True))
    return Counted(lambda *args: value(*args)[1])


def run(function, i, p, gradient=True, made=program):
    floats = {name: image for name, image in i.items() if name != "mask"}
    return made(function, gradient)(floats, i["mask"], p)


# Programs of float64 and of other shapes, apart from those whose number is counted.
uncounted = functools.cache(program.__wrapped__)


def as_numpy(tree):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


def not_finite(gradients):
    """The names of the gradients that are not finite."""
    leaves = jax.tree_util.tree_leaves_with_path(gradients)
    return [jax.tree_util.keystr(path) for path, leaf in leaves if not np.all(np.isfinite(leaf))]


def overflows(function, i, p):
    """Whether float64 says that a derivative is too large for float32, or so large that a product on the way to it is
    (a thousandth of the largest number): there, and only there, it may be infinite."""

    def wide(leaf):
        leaf = np.asarray(leaf)
        return leaf.astype(np.float64) if hostile.is_float(leaf) else leaf

    floats = {name: wide(image) for name, image in i.items() if name != "mask"}
    with jax.enable_x64(True):
        _, gradients = uncounted(function, True)(floats, i["mask"], jax.tree.map(wide, p))
    return max(np.max(np.abs(leaf), initial=0) for leaf in jax.tree.leaves(gradients)) > 1e-3 * np.finfo(np.float32).max


def check_outputs(out, shape, dtype):
    for leaf in jax.tree.leaves(out):
        assert leaf.shape[:2] in (shape, ())
        assert leaf.dtype in (dtype, bool)
        if hostile.is_float(leaf):
            assert np.all(np.isfinite(leaf))


TAME = hostile.Draw(
    seed=3, mask="random", normal="unit", depth=1e-2, curvature=-2, bad=None, alpha=2.0, gamma=1.0, light="any"
)
settings = hypothesis.settings(max_examples=25, deadline=None, derandomize=True, database=None)


# Gains at their bound, and a slope in n.l beyond the largest number, once.
STEEP = hostile.Draw(
    seed=1, mask="full", normal="long", depth=0.0, curvature=-12, bad=None, alpha=0.0, gamma=1e20, light="any"
)


@pytest.mark.parametrize(("function", "kind"), STAGES.values())
@settings
@hypothesis.example(draw=STEEP)
@hypothesis.given(draw=hostile.draws)
def test_pictures_and_gradients_of_hostile_inputs_are_finite_and_repeat(function, kind, draw):
    i, p = hostile.images(draw, SHAPE, np.float32), parameters(draw, np.float32)
    (_, out), gradients = first = run(function, i, p)
    again = run(function, i, p)
    assert all(a.tobytes() == b.tobytes() for a, b in zip(*map(as_numpy, (first, again)), strict=True))
    check_outputs(out, SHAPE, np.float32)
    assert program(function, True).traces == 1
    bad = not_finite(gradients)
    assert not bad or overflows(function, i, p)


@pytest.mark.parametrize(
    ("function", "kind"), [entry for entry in STAGES.values() if entry.values[1] in ("pixels", "neighbours")]
)
@pytest.mark.parametrize("bad", hostile.BAD[1:])
def test_bad_pixels_stay_alone(function, kind, bad):
    rng = np.random.default_rng(8)
    i, p = hostile.images(TAME, SHAPE, np.float32), parameters(TAME, np.float32)
    where = rng.random(SHAPE) < 0.15
    spoilt, without = dict(i), i | {"mask": i["mask"] & ~where}
    names = ("normal", "hessian", "albedo", "occlusion") if kind == "pixels" else ("normal",)
    for name in names:
        part = where & (rng.random(SHAPE) < 0.5) if kind == "pixels" else where
        spoilt[name] = np.where(part.reshape(*SHAPE, *(1,) * (i[name].ndim - 2)), np.float32(bad), i[name])
    (_, out), _ = run(function, spoilt, p)
    (_, wanted), _ = run(function, without, p)
    keep = ~where if kind == "pixels" else np.ones(SHAPE, bool)
    for a, b in zip(jax.tree.leaves(out), jax.tree.leaves(wanted), strict=True):
        assert np.array_equal(np.asarray(a)[keep], np.asarray(b)[keep])


@pytest.mark.thorough
@pytest.mark.parametrize("shape", TINY)
@pytest.mark.parametrize(("function", "kind"), STAGES.values())
def test_tiny_images_and_their_gradients(function, kind, shape):
    for seed, mask in enumerate(("full", "empty", "one pixel", "checkerboard")):
        draw = dataclasses.replace(TAME, seed=seed, mask=mask)
        i, p = hostile.images(draw, shape, np.float32), parameters(draw, np.float32)
        (_, out), gradients = run(function, i, p, made=uncounted)
        check_outputs(out, shape, np.float32)
        assert not not_finite(gradients)


@pytest.mark.thorough
@pytest.mark.parametrize(("function", "kind"), STAGES.values())
def test_double_precision_stays_double(function, kind, x64):
    for seed, bad in enumerate(hostile.BAD):
        draw = dataclasses.replace(TAME, seed=seed, bad=bad)
        i, p = hostile.images(draw, SHAPE, np.float64), parameters(draw, np.float64)
        check_outputs(run(function, i, p, gradient=False), SHAPE, np.float64)


# These have such a test beside their own module.
BATCHED_ELSEWHERE = ("shade", "shade_warped", "shade_scaled", "contrast", "line_field", "fit_profile", "draw_lines")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("function", "kind"),
    [stage for name, stage in STAGES.items() if not name.startswith(BATCHED_ELSEWHERE)],
)
def test_compiled_eager_and_batched_agree_and_repeat(function, kind):
    draws = [TAME, dataclasses.replace(TAME, seed=4, mask="full")]
    examples = [(hostile.images(d, SHAPE, np.float32), parameters(d, np.float32)) for d in draws]
    single = [run(function, *e, gradient=False) for e in examples]
    again = run(function, *examples[0], gradient=False)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(single[0]), jax.tree.leaves(again), strict=True))
    eager = function(*jax.tree.map(jnp.asarray, examples[0]))
    batched = jax.jit(jax.vmap(function))(*jax.tree.map(lambda *a: np.stack(a), *examples))
    for k, other in (
        (0, eager),
        (0, jax.tree.map(lambda a: a[0], batched)),
        (1, jax.tree.map(lambda a: a[1], batched)),
    ):
        for a, b in zip(jax.tree.leaves(single[k]), jax.tree.leaves(other), strict=True):
            a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
            assert np.max(np.abs(a - b)) <= 2e-4 * max(1e-3, np.max(np.abs(a)))


# ------------------------------------------------------------------------------------------- kernels


def coverage(i):
    """Any: four samples that borrow from pixels that may not be there."""
    seen = (i["mask"][..., None] & (i["noise"] > 0)).astype(jnp.float32)
    source = jnp.where(seen > 0, jnp.round(8 * i["noise"]), -1).astype(jnp.int8)
    return se.Coverage(source, jnp.mean(seen, axis=-1))


KERNELS = {
    "mean_curvature": lambda i, p: se.mean_curvature(i["hessian"]),
    "gaussian_curvature": lambda i, p: se.gaussian_curvature(i["hessian"]) * 1e-30,
    "principal_curvatures": lambda i, p: se.principal_curvatures(i["hessian"]),
    "principal_directions": lambda i, p: se.principal_directions(i["hessian"]),
    "warp_tensor": lambda i, p: se.warp_tensor(i["hessian"], p["alpha"], concave=p["concave"]),
    "warp": lambda i, p: se.warp(i["unit"], se.warp_tensor(i["hessian"], p["alpha"])),
    "unwarp": lambda i, p: se.unwarp(i["unit"], se.warp_tensor(i["hessian"], p["alpha"])),
    "warp_jacobian": lambda i, p: se.warp_jacobian(i["unit"], se.warp_tensor(i["hessian"], p["alpha"])),
    "curvature_mapping": lambda i, p: se.curvature_mapping(i["hessian"], i["unit"], p["anisotropy"]),
    "radiance_scale": lambda i, p: se.radiance_scale(
        i["hessian"][..., 0], i["noise"][..., 0], p["invariant"], p["gamma"]
    ),
    "ashikhmin_shirley": lambda i, p: se.ashikhmin_shirley(i["unit"], i["unit"][::-1], i["unit"][:, ::-1], material(p)),
    "environment_radiance": lambda i, p: se.environment_radiance(p["map"], i["unit"]),
    "harmonic_radiance": lambda i, p: se.harmonic_radiance(p["harmonics"], i["unit"]),
    "curvature_intensity": lambda i, p: se.curvature_intensity(i["noise"], beta=p["beta"]),
    "tone_map": lambda i, p: se.tone_map(i["image"], white=p["ior"]),
    "auto_exposure": lambda i, p: se.auto_exposure(i["image"], i["mask"]),
    "sample_texture": lambda i, p: se.sample_texture(p["map"], i["hessian"][..., :2]),
    "composite": lambda i, p: se.composite(i["image"], i["noise"][..., 0], p["diffuse"]),
    "composite_lines": lambda i, p: se.composite_lines(i["image"], i["noise"]),
    "resolve_coverage": lambda i, p: se.resolve_coverage(i["image"], coverage(i)),
    "spherical_harmonics": lambda i, p: se.spherical_harmonics(p["map"]),
    "prefilter_map": lambda i, p: se.prefilter_map(p["map"], height=4),
    "sample_environment": lambda i, p: se.sample_environment(p["map"], 5, rotation=p["alpha"]),
    "rotate_lights": lambda i, p: se.rotate_lights(p["lights"], p["camera"]),
}
for _name, _function in KERNELS.items():
    _function.__name__ = _name


@pytest.mark.parametrize("function", KERNELS.values(), ids=KERNELS)
@settings
@hypothesis.given(draw=hostile.draws)
def test_kernels_and_their_gradients_are_finite_for_finite_input(function, draw):
    draw = dataclasses.replace(draw, bad=None, normal="steps" if draw.normal == "zero" else draw.normal)
    i, p = hostile.images(draw, SHAPE, np.float32), parameters(draw, np.float32)
    direction = hostile.unit(np.where(np.all(i["normal"] == 0, axis=-1, keepdims=True), [0, 0, -1], i["normal"]))
    i["unit"] = np.asarray(direction, np.float32)
    (_, out), gradients = run(function, i, p)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(out))
    bad = not_finite(gradients)
    assert not bad or overflows(function, i, p)


# ------------------------------------------------------------------------------------------- bad arguments

BAD_CALLS = {
    "sigma is -1": lambda i, p: se.describe(gbuffer(i), sigma=-1.0),
    "sigma is nan": lambda i, p: se.describe(gbuffer(i), sigma=np.nan),
    "gbuffer.normal has shape": lambda i, p: se.describe(gbuffer(i | {"normal": i["depth"]})),
    "gbuffer is a Mesh": lambda i, p: se.describe(se.plane()),
    "alpha": lambda i, p: se.shade_warped(gbuffer(i), descriptor(i), p["lights"], material(p), alpha=np.inf),
    "gamma is 2": lambda i, p: se.shade_warped(
        gbuffer(i), descriptor(i), p["lights"], material(p), alpha=1.0, gamma=2.0
    ),
    "descriptor.hessian has shape": lambda i, p: se.shade_warped(
        gbuffer(i), descriptor(i | {"hessian": i["hessian"][1:]}), p["lights"], material(p), alpha=1.0
    ),
    "lights.direction has shape": lambda i, p: se.shade(gbuffer(i), se.Lights(i["depth"], i["depth"]), material(p)),
    "lights.radiance": lambda i, p: se.shade(
        gbuffer(i), se.Lights(p["lights"].direction, p["lights"].radiance * np.nan), material(p)
    ),
    "material.diffuse is 2": lambda i, p: se.shade(gbuffer(i), p["lights"], se.Material(np.full(3, 2.0))),
    "material.shininess": lambda i, p: se.shade(gbuffer(i), p["lights"], se.Material(np.ones(3), np.ones(3), -1.0)),
    "hessian has shape": lambda i, p: se.warp_tensor(i["depth"], 1.0),
    "invariant is 1": lambda i, p: se.radiance_scale(0.5, 0.5, 1.0, 1.0),
    "measure is 'sharpness'": lambda i, p: se.contrast(i["image"], i["mask"], measure="sharpness"),
    "radius": lambda i, p: se.fit_profile(field(i), radius=0.1),
    "kind is 'crest'": lambda i, p: se.line_field("crest", gbuffer(i), descriptor(i)),
    "spacing is 0": lambda i, p: se.gbuffer_from_height(i["height"], spacing=0.0),
    "normal has shape": lambda i, p: se.gbuffer_from_normals(i["depth"]),
    "radiance_map has shape": lambda i, p: se.environment_radiance(i["depth"], i["normal"]),
    "count is 0": lambda i, p: se.sample_environment(p["map"], 0),
    "fov_degrees is 180": lambda i, p: se.perspective_camera((0, 0, 1), (0, 0, 0), fov_degrees=180.0),
    "height is 0": lambda i, p: se.rasterize(se.plane(), p["camera"], height=0, width=4),
    "mesh.vertices holds": lambda i, p: se.rasterize(
        se.Mesh(np.full((3, 3), np.nan), np.array([[0, 1, 2]]), np.ones((3, 3))), p["camera"], height=4, width=4
    ),
}


@pytest.mark.parametrize("message", BAD_CALLS)
def test_bad_arguments_are_named(message):
    i, p = hostile.images(TAME, SHAPE, np.float32), parameters(TAME, np.float32)
    with pytest.raises(ValueError, match=message) as error:
        BAD_CALLS[message](i, p)
    assert "accepted" in str(error.value)
