"""The sums over lights: the twin, laws, gradients against central differences, skipping, bad pixels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from shapeenh.types import replace
from tests.reference import light as reference

HEIGHT, WIDTH = 21, 27  # 12 blocks, the outer ones partial


def unit(rng, *shape):
    v = rng.normal(size=(*shape, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def make_scene(rng, dtype, *, lights=40, spread=0.0, coverage=0.7):
    """Random normals, Hessians over 2 `spread` orders of magnitude, lights over the whole sphere."""
    normal = unit(rng, HEIGHT, WIDTH)
    normal[..., 2] = np.abs(normal[..., 2])
    hessian = rng.normal(size=(HEIGHT, WIDTH, 3)) * 10 ** rng.uniform(-spread, spread, (HEIGHT, WIDTH, 1))
    mask = rng.uniform(size=(HEIGHT, WIDTH)) < coverage
    plane = jnp.ones((HEIGHT, WIDTH), dtype)
    normal, hessian = jnp.asarray(normal, dtype), jnp.asarray(hessian, dtype)
    gbuffer = se.GBuffer(jnp.asarray(mask), plane, normal, normal)
    descriptor = se.Descriptor(hessian, hessian[..., :2], plane, plane, plane)
    light = se.Lights(jnp.asarray(unit(rng, lights), dtype), jnp.asarray(rng.uniform(size=(lights, 3)), dtype))
    material = se.Material(
        jnp.asarray([0.6, 0.5, 0.4], dtype), jnp.asarray([0.05, 0.1, 0.3], dtype), jnp.asarray(20.0, dtype)
    )
    return gbuffer, descriptor, light, material


def twin(gbuffer, descriptor, lights, material, alpha=0.0, gamma=0.0, albedo=1.0):
    wide = [np.asarray(a, np.float64) for a in (gbuffer.normal, descriptor.hessian, lights.direction, lights.radiance)]
    diffuse, specular = np.asarray(material.diffuse, np.float64) * albedo, np.asarray(material.specular, np.float64)
    out = reference.shade_warped(*wide, diffuse, specular, float(material.shininess), alpha, gamma)
    return np.where(np.asarray(gbuffer.mask)[..., None], out, 0)


def assert_relative(got, expected, tolerance):
    """Every pixel within `tolerance` of its own value."""
    inside = expected > 0
    np.testing.assert_array_equal(np.asarray(got)[~inside], 0)
    assert np.max(np.abs(np.asarray(got)[inside] / expected[inside] - 1)) < tolerance


# ------------------------------------------------------------------------------------------- the twin and the laws


@pytest.mark.parametrize(("alpha", "gamma"), [(3.0, 0.3), (-0.4, 0.0), (1e3, -1.0)])
def test_warped_radiance_equals_the_twin(dtype, rng, alpha, gamma):
    scene = make_scene(rng, dtype, spread=3.0)
    got = se.shade_warped(*scene, alpha=alpha, gamma=gamma)
    assert got.dtype == dtype
    assert_relative(got, twin(*scene, alpha, gamma), 1e-4 if dtype == np.float32 else 1e-10)


def test_plain_radiance_equals_the_twin_and_the_unwarped_one(dtype, rng):
    gbuffer, descriptor, lights, material = make_scene(rng, dtype)
    tolerance = 1e-4 if dtype == np.float32 else 1e-10
    plain = se.shade(gbuffer, lights, material)
    assert_relative(plain, twin(gbuffer, descriptor, lights, material), tolerance)
    # Traced, alpha = 0 takes the general way.
    general = jax.jit(lambda a: se.shade_warped(gbuffer, descriptor, lights, material, alpha=a))(0.0)
    assert_relative(general, np.asarray(plain, np.float64), 2e-5 if dtype == np.float32 else 1e-12)


def test_albedo_multiplies_the_diffuse_reflectance(x64, rng):
    gbuffer, descriptor, lights, material = make_scene(rng, x64)
    albedo = rng.uniform(size=(HEIGHT, WIDTH, 3))
    got = se.shade(replace(gbuffer, albedo=jnp.asarray(albedo)), lights, material)
    assert_relative(got, twin(gbuffer, descriptor, lights, material, albedo=albedo), 1e-10)


@pytest.mark.parametrize("way", ["plain", "warped", "scaled", "both"])
def test_without_a_specular_lobe_the_diffuse_one_is_left(x64, rng, way):
    """For R_s = s the picture is (1 - s) times the matte one, and the specular lobe's own."""
    gbuffer, descriptor, lights, material = make_scene(rng, x64)

    def shade(diffuse, specular):
        m = se.Material(diffuse, specular, material.shininess)
        if way == "plain":
            return se.shade(gbuffer, lights, m)
        function = se.shade_warped if way == "warped" else se.shade_scaled
        return function(gbuffer, descriptor, lights, m, **OPTIONS[way])

    both, lobe = shade(material.diffuse, material.specular), shade(jnp.zeros(3), material.specular)
    expected = (np.asarray(both) - np.asarray(lobe)) / (1 - np.asarray(material.specular))
    np.testing.assert_allclose(shade(material.diffuse, None), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("way", ["plain", "warped", "scaled", "both"])
def test_a_specular_reflectance_without_colour_is_an_equal_one_in_every_channel(dtype, rng, way):
    """Its sum is another one: however it is given, the picture is that of a colour nobody knows."""
    gbuffer, descriptor, lights, material = make_scene(rng, dtype)

    def shade(specular):
        m = se.Material(material.diffuse, specular, material.shininess)
        if way == "plain":
            return se.shade(gbuffer, lights, m)
        function = se.shade_warped if way == "warped" else se.shade_scaled
        return function(gbuffer, descriptor, lights, m, **OPTIONS[way])

    for value in (0.0, 0.3, 1.0):
        colour = jax.jit(shade)(jnp.full(3, value, dtype))
        for given in (value, jnp.asarray(value), np.full(3, value), jnp.full((HEIGHT, WIDTH), value, dtype)):
            assert_relative(shade(given), np.asarray(colour, np.float64), 2e-5 if dtype == np.float32 else 1e-12)


def test_radiance_is_linear_in_the_lights(x64, rng):
    gbuffer, descriptor, lights, material = make_scene(rng, x64)
    halves = [se.Lights(lights.direction[s], lights.radiance[s]) for s in (slice(0, 13), slice(13, None))]
    whole, *parts = (se.shade_warped(gbuffer, descriptor, h, material, alpha=2.0) for h in (lights, *halves))
    np.testing.assert_allclose(whole, sum(parts), rtol=1e-12, atol=1e-14)


def test_many_lights_and_few(x64, rng):
    for count in (1, 9, 300):
        scene = make_scene(rng, x64, lights=count)
        assert_relative(se.shade_warped(*scene, alpha=1.0), twin(*scene, 1.0), 1e-10)


# ------------------------------------------------------------------------------------------- gradients


OPTIONS = {
    "warped": {"alpha": 2.0, "gamma": 0.4, "concave": 0.7},
    "scaled": {"invariant": 0.4, "gamma_diffuse": 1.2, "gamma_specular": 0.8, "concave": 0.6},
    "both": {"invariant": 0.4, "gamma_diffuse": 1.2, "gamma_specular": 0.8, "concave": 0.6, "anisotropy": 0.5}
    | {"alpha": 2.0, "contrast": -0.3},
}


def image_of_everything(scene, kind):
    """(image, values): the weighed sum of the picture as a function of a dict of every input."""
    gbuffer, descriptor, lights, material = scene
    weight = jnp.asarray(np.random.default_rng(5).normal(size=(HEIGHT, WIDTH, 3)))
    options = OPTIONS[kind.split()[-1]]
    shade = se.shade_warped if "invariant" not in options else se.shade_scaled

    def image(v):
        direction = v["direction"] / jnp.linalg.norm(v["direction"], axis=-1, keepdims=True)
        changed = (
            replace(gbuffer, normal=v["normal"], albedo=v["albedo"]),
            replace(descriptor, hessian=v["hessian"]),
            se.Lights(direction, v["radiance"]),
            se.Material(v["diffuse"], v.get("specular"), v.get("shininess", 1.0)),
        )
        return jnp.sum(weight * shade(*changed, **{name: v[name] for name in options}))

    values = {
        "normal": gbuffer.normal,
        "albedo": jnp.full((HEIGHT, WIDTH, 3), 0.8),
        "hessian": 0.2 * descriptor.hessian,
    }
    values |= {"direction": lights.direction, "radiance": lights.radiance}
    values |= {name: getattr(material, name) for name in ("diffuse", "specular", "shininess")}
    if kind.startswith("matte"):
        del values["specular"], values["shininess"]
    if kind.startswith("grey"):
        values["specular"] = jnp.asarray(0.2)
    if kind.startswith("grey map"):
        values["specular"] = jnp.linspace(0, 1, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    return image, values | {name: jnp.asarray(value) for name, value in options.items()}


@pytest.mark.parametrize("kind", ["matte warped", "matte both", "grey both", "grey map warped"])  # others: test_claims
def test_gradients_equal_central_differences(x64, rng, kind):
    image, values = image_of_everything(make_scene(rng, x64, lights=11), kind)
    gradient = jax.jit(jax.grad(image))(values)
    image = jax.jit(image)
    for name, value in values.items():
        v = rng.normal(size=value.shape)
        v = jnp.asarray(v / np.linalg.norm(v))
        got = float(jnp.sum(gradient[name] * v))
        # A large step moves some light over some pixel's horizon, where radiance has a kink: hence the sweep.
        found = [
            float(image(values | {name: value + h * v}) - image(values | {name: value - h * v})) / (2 * h)
            for h in (1e-4, 1e-5, 1e-6, 1e-7)
        ]
        error = min(abs(got - f) for f in found)
        assert error < 1e-6 * max(1.0, abs(got)), f"{name}: gradient {got}, differences {found}"


def test_what_is_not_asked_for_changes_nothing(x64, rng):
    """Derivatives that nobody wants are not computed; those that are wanted do not notice."""
    image, values = image_of_everything(make_scene(rng, x64, lights=11), "warped")
    together = jax.jit(jax.grad(image))(values)
    for name in ("alpha", "radiance"):
        alone = jax.jit(jax.grad(lambda v, n=name: image(values | {n: v})))(values[name])
        np.testing.assert_allclose(alone, together[name], rtol=1e-12)


@pytest.mark.parametrize("reflectance", [0.0, (0.0, 0.0, 0.0)])
@pytest.mark.parametrize("kind", ["warped", "both"])
def test_gradients_are_finite_at_singular_pixels(dtype, kind, reflectance):
    """Umbilics, zero and huge Hessians, normals along and across the view, lights at both poles."""
    normal = np.tile([[0, 0, 1], [1, 0, 0], [0, 1, 0], [0.6, 0, -0.8]], (2, 1)).reshape(2, 4, 3)
    hessian = np.array([[[0, 0, 0], [1, 0, 1], [1e30, 0, -1e30], [-1e30, 1e30, 3]]] * 2)
    plane = jnp.ones((2, 4), dtype)
    normal, hessian = jnp.asarray(normal, dtype), jnp.asarray(hessian, dtype)
    scene = (
        se.GBuffer(plane > 0, plane, normal, normal),
        se.Descriptor(hessian, hessian[..., :2], plane, plane, plane),
        se.Lights(jnp.asarray([[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, 1, 0]], dtype), jnp.ones((4, 3), dtype)),
        se.Material(jnp.full(3, 0.5, dtype), jnp.asarray(reflectance, dtype), jnp.asarray(0.0, dtype)),
    )
    gbuffer, descriptor, lights, material = scene
    options = {"alpha": 1e6} if kind == "warped" else {"alpha": 1e6, "invariant": 0.5, "anisotropy": 1.0}
    options |= {} if kind == "warped" else {"gamma_diffuse": 1e4, "gamma_specular": 1e4}
    shade = se.shade_warped if kind == "warped" else se.shade_scaled

    def total(n, h, l, m, o):
        return jnp.sum(shade(replace(gbuffer, normal=n), replace(descriptor, hessian=h), l, m, **o))

    arguments = normal, hessian, lights, material, jax.tree.map(lambda v: jnp.asarray(v, dtype), options)
    value, gradients = jax.value_and_grad(total, tuple(range(5)))(*arguments)
    assert np.isfinite(value)
    assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(gradients))


# ------------------------------------------------------------------------------------------- skipping, bad pixels


def test_dark_lights_and_padding_change_nothing(dtype, rng):
    gbuffer, descriptor, lights, material = make_scene(rng, dtype)
    dark = se.Lights(
        jnp.concatenate([lights.direction, lights.direction[:9]]),
        jnp.concatenate([lights.radiance, jnp.zeros((9, 3), dtype)]),
    )
    a, b = (se.shade_warped(gbuffer, descriptor, l, material, alpha=2.0) for l in (lights, dark))
    np.testing.assert_array_equal(a, b)


def test_no_lights_give_black(dtype, rng):
    gbuffer, descriptor, _, material = make_scene(rng, dtype)
    none = se.Lights(jnp.zeros((0, 3), dtype), jnp.zeros((0, 3), dtype))
    np.testing.assert_array_equal(se.shade_warped(gbuffer, descriptor, none, material, alpha=2.0), 0)


def test_another_number_of_lights_does_not_recompile(rng, compilations):
    gbuffer, descriptor, lights, material = make_scene(rng, np.float32)
    for count in (33, 40, 37):
        few = se.Lights(lights.direction[:count], lights.radiance[:count])
        se.shade_warped(gbuffer, descriptor, few, material, alpha=float(count), gamma=0.1)
    assert compilations.count("jit(_shade_image)") <= 1  # none when another test has compiled it


def test_borders_of_fusion_outlast_constants(rng):
    """A loss may close over all but one number; the borders between stages are not folded away with the constants."""
    scene = make_scene(rng, np.float32)

    def loss(alpha):
        return jnp.sum(se.shade_warped(*scene, alpha=alpha))

    def conditionals(function):
        return jax.jit(function).lower(1.0).compile().as_text().count(" conditional(")

    assert conditionals(loss) >= 2
    assert conditionals(jax.grad(loss)) >= 4


def test_empty_mask_and_images_of_any_size(dtype, rng):
    _, _, lights, material = make_scene(rng, dtype)
    for height, width in ((1, 1), (1, 70), (9, 8), (5, 3)):
        normal = jnp.asarray(unit(rng, height, width), dtype)
        for value in (True, False):
            plane = jnp.ones((height, width), dtype)
            gbuffer = se.GBuffer(jnp.full((height, width), value), plane, normal, normal)
            got = se.shade(gbuffer, lights, material)
            assert got.shape == (height, width, 3)
            assert (np.all(np.asarray(got) == 0)) == (not value)


def test_bad_pixels_stay_alone(dtype, rng):
    gbuffer, descriptor, lights, material = make_scene(rng, dtype, coverage=2.0)
    normal = gbuffer.normal.at[3, 4].set(jnp.nan).at[0, 0, 1].set(jnp.inf)
    hessian = descriptor.hessian.at[10, 11].set(jnp.nan)

    def total(alpha, n, h):
        image = se.shade_warped(
            replace(gbuffer, normal=n), replace(descriptor, hessian=h), lights, material, alpha=alpha
        )
        return jnp.sum(image), image

    (_, image), gradients = jax.value_and_grad(total, (0, 1, 2), has_aux=True)(2.0, normal, hessian)
    good = total(2.0, gbuffer.normal, descriptor.hessian)[1]
    bad = np.zeros((HEIGHT, WIDTH), bool)
    bad[[3, 0, 10], [4, 0, 11]] = True
    np.testing.assert_array_equal(np.asarray(image)[bad], 0)
    np.testing.assert_array_equal(np.asarray(image)[~bad], np.asarray(good)[~bad])
    assert all(np.all(np.isfinite(g)) for g in gradients)


def test_batches_by_vmap(x64, rng):
    gbuffer, descriptor, lights, material = make_scene(rng, x64)
    strengths = jnp.asarray([0.5, 2.0])

    def image(a):
        return se.shade_warped(gbuffer, descriptor, lights, material, alpha=a)

    batch = jax.vmap(image)(strengths)
    for got, a in zip(batch, strengths, strict=True):
        np.testing.assert_allclose(got, image(a), rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"alpha": np.nan}, "alpha holds 1 NaN"),
        ({"gamma": 1.5}, r"gamma is 1.5; accepted are finite numbers in \[-1, 1\]"),
        ({"alpha": np.ones((3, 2))}, r"alpha has shape \(3, 2\)"),
        ({"material": se.Material(2.0, 0.1, 10.0)}, r"material.diffuse is 2"),
        ({"material": se.Material(0.5, 0.1, -1.0)}, "material.shininess is -1"),
        (
            {"material": se.Material(0.5, np.full((2, 5), 0.1), 1.0)},
            r"material.specular has shape \(2, 5\); accepted is \[\], \[3\] or a map of 21 x 27 pixels",
        ),
        ({"lights": se.Lights(np.zeros((4, 3)), np.zeros((3, 3)))}, r"lights.radiance has shape \(3, 3\)"),
        ({"gbuffer": None}, "gbuffer is a NoneType; accepted is a GBuffer"),
    ],
)
def test_wrong_arguments_are_named(rng, change, words):
    names = ("gbuffer", "descriptor", "lights", "material")
    arguments = dict(zip(names, make_scene(rng, np.float32), strict=True)) | {"alpha": 1.0} | change
    with pytest.raises(ValueError, match=words):
        se.shade_warped(**arguments)
