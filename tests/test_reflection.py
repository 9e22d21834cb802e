"""Looks that look light up: maps, mirror, refraction, diffuse, eq. 1 against eq. 2, occlusion, lit spheres, Phong."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from shapeenh.scene.environment import map_directions, map_solid_angles
from shapeenh.types import replace
from tests.reference import light as reference
from tests.reference.differences import assert_gradient

SIZE = 24


def ball(dtype, rng, *, curvature=0.05):
    """A ball that fills the picture, with a random Hessian, and positions for a camera at distance 4."""
    row, column = np.mgrid[:SIZE, :SIZE]
    x, y = (column + 0.5) / (SIZE / 2) - 1, 1 - (row + 0.5) / (SIZE / 2)
    mask = x * x + y * y < 0.95
    z = np.sqrt(np.maximum(1 - x * x - y * y, 0.01))
    normal = np.stack([x, y, z], -1) / np.linalg.norm(np.stack([x, y, z], -1), axis=-1, keepdims=True)
    position = np.stack([x, y, z - 4], -1)
    hessian = rng.normal(size=(SIZE, SIZE, 3)) * curvature
    normal, position, hessian = (jnp.asarray(a * mask[..., None], dtype) for a in (normal, position, hessian))
    plane = jnp.ones((SIZE, SIZE), dtype)
    gbuffer = se.GBuffer(jnp.asarray(mask), -position[..., 2], normal, position)
    return gbuffer, se.Descriptor(hessian, hessian[..., :2], plane, plane, plane)


def smooth_map(dtype, height=64):
    """Low frequencies: quadrature and lookup converge fast."""
    d = np.asarray(map_directions(height=height, width=2 * height), np.float64)
    out = 1 + 0.5 * d @ np.array([[0.6, 0.1, -0.3], [0.4, 0.8, 0.2], [0.2, -0.3, 0.7]]) + (d[..., :1] * d[..., 1:2])
    return jnp.asarray(np.maximum(out, 0), dtype)


# ------------------------------------------------------------------------------------------- lookups


def test_lookup_at_pixel_centres_gives_the_pixels_and_wraps(dtype, rng):
    radiance = jnp.asarray(rng.uniform(size=(8, 16, 3)), dtype)
    centres = map_directions(height=8, width=16).astype(dtype)
    np.testing.assert_allclose(se.environment_radiance(radiance, centres), radiance, atol=2e-5)
    # Half-way between the last and the first column, straight behind.
    seam = se.environment_radiance(
        radiance, jnp.asarray([0.0, np.cos(np.pi * 3.5 / 8), np.sin(np.pi * 3.5 / 8)], dtype)
    )
    np.testing.assert_allclose(seam, 0.5 * (radiance[3, 0] + radiance[3, -1]), atol=2e-5)


def test_lookup_and_its_gradient_are_finite_at_the_poles(dtype, rng):
    radiance = jnp.asarray(rng.uniform(size=(8, 16, 3)), dtype)
    poles = jnp.asarray([[0, 1, 0], [0, -1, 0], [1e-20, 1, 0], [0, 0, -1]], dtype)
    gradients = jax.grad(lambda m, d: jnp.sum(se.environment_radiance(m, d)), (0, 1))(radiance, poles)
    assert all(np.all(np.isfinite(g)) for g in gradients)


def test_prefiltered_map_is_the_cosine_convolution(x64, rng):
    radiance = jnp.asarray(rng.uniform(size=(32, 64, 3)))
    np.testing.assert_allclose(se.prefilter_map(jnp.ones((32, 64, 3)), height=8), 1, rtol=1e-12)
    direction, solid = (
        np.asarray(map_directions(height=32, width=64)),
        np.asarray(map_solid_angles(height=32, width=64)),
    )
    normal = np.asarray(map_directions(height=8, width=16))[3, 5]
    cosine = np.maximum(direction @ normal, 0) * solid
    expected = np.sum(cosine[..., None] * np.asarray(radiance), (0, 1)) / np.sum(cosine)
    np.testing.assert_allclose(se.prefilter_map(radiance, height=8)[3, 5], expected, rtol=1e-12)


def test_harmonics_are_exact_for_a_smooth_map(x64):
    """A map of order 2 has no other coefficients, so both ways to its irradiance agree."""
    d = np.asarray(map_directions(height=64, width=128))
    radiance = jnp.asarray(3 + d @ np.diag([1.0, 0.5, -0.7]) + d[..., :1] * d[..., 2:3])
    normal = map_directions(height=16, width=32)
    harmonic = se.harmonic_radiance(se.spherical_harmonics(radiance), normal)
    np.testing.assert_allclose(harmonic, se.prefilter_map(radiance, height=16), rtol=2e-3)


# ------------------------------------------------------------------------------------------- eq. 1 and eq. 2


@pytest.mark.parametrize("gamma", [0.0, 0.5])
def test_the_forward_and_the_inverse_form_converge_to_each_other(x64, rng, gamma):
    gbuffer, descriptor = ball(x64, rng)
    # A smooth map: near the horizon of a pixel both are step-wise in the number of samples.
    radiance = smooth_map(x64)
    material = se.Material(0.6, 0.1, 5.0)
    errors = []
    for count in (256, 1024, 4096):
        lights = se.sample_environment(radiance, count, method="uniform")
        inverse = se.shade_warped(gbuffer, descriptor, lights, material, alpha=20.0, gamma=gamma)
        forward = se.shade_forward(gbuffer, descriptor, radiance, material, alpha=20.0, gamma=gamma, samples=count)
        inside = np.asarray(gbuffer.mask)
        errors.append(np.sqrt(np.mean((np.asarray(forward / inverse)[inside] - 1) ** 2)))
    assert errors[1] < 0.6 * errors[0]
    assert errors[2] < 0.6 * errors[1]
    assert errors[2] < 0.02


def test_a_furnace_gives_the_directional_albedo(x64, rng):
    """A constant environment: radiance is the albedo for light from everywhere, whatever the direction of the map."""
    gbuffer, descriptor = ball(x64, rng)
    lights = se.sample_environment(jnp.ones((64, 128, 3)), 4096, method="uniform")
    image = np.asarray(se.shade(gbuffer, lights, se.Material(1.0, 0.0, 10.0)))
    centre = image[SIZE // 2, SIZE // 2]
    assert centre == pytest.approx(0.9688, abs=6e-3)  # n is 0.06 rad off the view
    assert image.max() <= 1.0 + 6e-3
    forward = se.shade_forward(
        gbuffer, descriptor, jnp.ones((8, 16, 3)), se.Material(1.0, 0.0, 10.0), alpha=0.0, samples=4096
    )
    np.testing.assert_allclose(forward, image, atol=1e-2)


# ------------------------------------------------------------------------------------------- one direction per pixel


def test_mirror_and_refraction_look_where_the_laws_say(x64, rng):
    gbuffer, _ = ball(x64, rng)
    inside = np.asarray(gbuffer.mask)
    n = np.asarray(gbuffer.normal)[inside]
    radiance = smooth_map(x64)
    mirrored = 2 * n[:, 2:] * n - np.array([0, 0, 1.0])
    got = np.asarray(se.shade_mirror(gbuffer, radiance))[inside]
    np.testing.assert_allclose(got, se.environment_radiance(radiance, jnp.asarray(mirrored)), rtol=1e-12)

    # Snell: t in the plane of n and z, sines in the ratio of the indices.
    t = np.asarray(se.shade_refraction(gbuffer, radiance, ior=1.0))[inside]
    straight = se.environment_radiance(radiance, jnp.asarray([0.0, 0.0, -1.0]))
    np.testing.assert_allclose(t[n[:, 2] > 0.9], np.broadcast_to(straight, t[n[:, 2] > 0.9].shape), rtol=1e-3)


def test_refracted_directions_obey_snell(x64, rng):
    from shapeenh.light.reflection import _refracted_direction

    n = rng.normal(size=(6, 7, 3))
    n[..., 2] = np.abs(n[..., 2])
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    t = np.asarray(_refracted_direction(jnp.asarray(n), {"ior": jnp.full((6, 7), 1.5)}))
    np.testing.assert_allclose(np.linalg.norm(t, axis=-1), 1, rtol=1e-12)
    sine_in = np.linalg.norm(np.cross(n, [0, 0, 1.0]), axis=-1)
    np.testing.assert_allclose(np.linalg.norm(np.cross(n, t), axis=-1), sine_in / 1.5, atol=1e-12)
    assert np.all(np.sum(n * t, -1) < 0)


@pytest.mark.parametrize("shade", [se.shade_mirror, se.shade_refraction, se.shade_diffuse])
def test_warped_and_scaled_lookups(x64, rng, shade):
    gbuffer, descriptor = ball(x64, rng)
    radiance = smooth_map(x64)
    plain = np.asarray(shade(gbuffer, radiance))
    general = jax.jit(lambda a, g: shade(gbuffer, radiance, descriptor=descriptor, alpha=a, gamma=g))
    np.testing.assert_allclose(general(0.0, 0.0), plain, rtol=1e-11, atol=1e-14)
    assert np.max(np.abs(np.asarray(general(20.0, 0.0)) - plain)) > 0.01
    assert np.max(np.abs(np.asarray(general(0.0, 2.0)) - plain)) > 1e-3

    weight = jnp.asarray(rng.normal(size=(SIZE, SIZE, 3)))
    assert_gradient(lambda a: jnp.sum(weight * general(a, 0.5)), jnp.asarray(3.0), rtol=1e-5)
    assert_gradient(lambda g: jnp.sum(weight * general(3.0, g)), jnp.asarray(0.5))


def test_warped_mirror_looks_up_the_warped_direction(x64, rng):
    gbuffer, descriptor = ball(x64, rng)
    inside = np.asarray(gbuffer.mask)
    n, h = np.asarray(gbuffer.normal)[inside], np.asarray(descriptor.hessian)[inside]
    mirrored = 2 * n[:, 2:] * n - np.array([0, 0, 1.0])
    radiance = smooth_map(x64)
    got = np.asarray(se.shade_mirror(gbuffer, radiance, descriptor=descriptor, alpha=20.0))[inside]
    expected = se.environment_radiance(radiance, jnp.asarray(reference.warp(mirrored, h, 20.0)))
    np.testing.assert_allclose(got, expected, rtol=1e-9)


def test_rotation_turns_the_map(x64, rng):
    gbuffer, _ = ball(x64, rng)
    radiance = smooth_map(x64)
    camera = se.perspective_camera((3.0, 2.0, 1.0), (0.0, 0.0, 0.0), fov_degrees=40.0, aspect=1.0)
    turn = np.asarray(camera.view)[:3, :3].T
    inside = np.asarray(gbuffer.mask)
    world = np.asarray(gbuffer.normal)[inside] @ turn.T
    got = np.asarray(se.shade_diffuse(gbuffer, radiance, rotation=turn, albedo=1.0))[inside]
    np.testing.assert_allclose(got, se.environment_radiance(radiance, jnp.asarray(world)), rtol=1e-12)


def test_diffuse_light_by_harmonics_is_close_to_the_map(x64, rng):
    gbuffer, descriptor = ball(x64, rng)
    radiance = smooth_map(x64)
    tables = se.prefilter_map(radiance), se.spherical_harmonics(radiance)
    for options in ({}, {"alpha": 20.0, "contrast": 0.5}, {"gamma": 1.0}):
        a, b = (se.shade_diffuse(gbuffer, t, descriptor=descriptor, **options) for t in tables)
        np.testing.assert_allclose(a, b, rtol=0.03, atol=1e-12)


# ------------------------------------------------------------------------------------------- Phong


def test_phong_is_the_printed_formula(dtype, rng):
    gbuffer, _ = ball(dtype, rng)
    inside = np.asarray(gbuffer.mask)
    n = np.asarray(gbuffer.normal, np.float64)[inside]
    l = np.array([[-0.5, 0.6, 0.62], [0.3, -0.8, 0.2]])
    l /= np.linalg.norm(l, axis=-1, keepdims=True)
    lights = se.Lights(jnp.asarray(l, dtype), jnp.asarray([[1, 0.9, 0.8], [0.2, 0.3, 0.4]], dtype))
    got = se.shade_phong(gbuffer, lights, ambient=0.1, diffuse=0.7, specular=0.2, shininess=30.0, exponent=0.6)
    expected = np.full((len(n), 3), 0.1)
    for d, c in zip(l, np.asarray(lights.radiance, np.float64), strict=True):
        cos = n @ d
        mirrored = np.maximum((2 * cos[:, None] * n - d)[:, 2], 0)
        lobe = 0.7 * np.maximum(cos, 0) ** 0.6 + 0.2 * np.where(cos > 0, mirrored, 0) ** 30
        expected += lobe[:, None] * c
    np.testing.assert_allclose(np.asarray(got)[inside], expected, rtol=1e-4 if dtype == np.float32 else 1e-11)


def test_scaling_of_each_component_of_phong_is_its_own(x64, rng):
    gbuffer, descriptor = ball(x64, rng, curvature=0.5)
    lights = se.Lights(jnp.asarray([[-0.48, 0.6, 0.64]]), jnp.ones((1, 3)))
    colours = {"ambient": 0.3, "diffuse": 0.5, "specular": 0.2}
    whole = se.shade_phong(gbuffer, lights, descriptor=descriptor, gamma_diffuse=2.0, **colours)
    parts = [
        se.shade_phong(gbuffer, lights, descriptor=descriptor, gamma_diffuse=g, **({k: 0.0 for k in colours} | {n: c}))
        for (n, c), g in zip(colours.items(), (0.0, 2.0, 0.0), strict=True)
    ]
    np.testing.assert_allclose(whole, sum(parts), rtol=1e-12)


def test_scaled_ambient_light_is_mean_curvature_shading(x64, rng):
    gbuffer, descriptor = ball(x64, rng, curvature=0.5)
    none = se.Lights(jnp.zeros((0, 3)), jnp.zeros((0, 3)))
    image = np.asarray(se.shade_phong(gbuffer, none, descriptor=descriptor, ambient=0.4, gamma_ambient=1.5))[..., 0]
    mean = np.asarray(descriptor.hessian[..., 0] + descriptor.hessian[..., 2]) / 2
    inside = np.asarray(gbuffer.mask)
    np.testing.assert_allclose(image[inside], 0.4 * np.exp(-1.5 * np.tanh(mean[inside])), rtol=1e-12)


# ------------------------------------------------------------------------------------------- occlusion


def bowl(dtype):
    """A height field seen from above by an orthographic camera: a deep hollow in a plane."""
    row, column = np.mgrid[:48, :48]
    x, y = (column + 0.5) / 24 - 1, 1 - (row + 0.5) / 24
    r2 = (x * x + y * y) / 0.16
    height = -0.8 * np.exp(-r2)
    slope = -0.8 * np.exp(-r2) * (-2 / 0.16)
    normal = np.stack([-slope * x, -slope * y, np.ones_like(x)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    position = np.stack([x, y, height - 3], -1)
    camera = se.orthographic_camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), height=2.0, aspect=1.0)
    normal, position = jnp.asarray(normal, dtype), jnp.asarray(position, dtype)
    return se.GBuffer(jnp.ones((48, 48), bool), -position[..., 2], normal, position), camera


def test_a_hollow_is_darker_than_its_rim_and_a_plane_is_open(dtype):
    gbuffer, camera = bowl(dtype)
    amount = np.asarray(se.ambient_occlusion(gbuffer, camera, radius=0.6))
    assert amount.dtype == dtype
    assert np.all((amount >= 0) & (amount <= 1))
    assert amount[24, 24] < 0.6
    assert amount[2, 2] > 0.95
    flat = se.GBuffer(
        gbuffer.mask, jnp.full((48, 48), 3.0, dtype), jnp.zeros((48, 48, 3), dtype).at[..., 2].set(1),
        gbuffer.position.at[..., 2].set(-3),
    )  # fmt: skip
    np.testing.assert_array_equal(se.ambient_occlusion(flat, camera, radius=0.6), 1)


def test_warped_occlusion_without_strength_is_the_plain_one_in_the_limit(x64):
    gbuffer, camera = bowl(x64)
    hessian = jnp.zeros((48, 48, 3))
    plane = jnp.ones((48, 48))
    descriptor = se.Descriptor(hessian, hessian[..., :2], plane, plane, plane)
    plain = se.ambient_occlusion(gbuffer, camera, radius=0.6, directions=256)
    warped = se.ambient_occlusion(gbuffer, camera, radius=0.6, directions=256, descriptor=descriptor, alpha=30.0)
    np.testing.assert_allclose(warped, plain, atol=0.02)


# ------------------------------------------------------------------------------------------- lit spheres


def painted_ball(dtype, size=128):
    row, column = np.mgrid[:size, :size]
    x, y = (column + 0.5) / (size / 2) - 1, 1 - (row + 0.5) / (size / 2)
    return jnp.asarray(np.stack([0.5 + 0.4 * x, 0.5 + 0.4 * y, 0.5 - 0.3 * x * y], -1), dtype)


def test_lit_sphere_looks_up_the_normal(dtype, rng):
    gbuffer, _ = ball(dtype, rng)
    got = np.asarray(se.lit_sphere(gbuffer, painted_ball(dtype)))
    inside = np.asarray(gbuffer.mask)
    x, y = np.asarray(gbuffer.normal, np.float64)[inside][:, 0], np.asarray(gbuffer.normal, np.float64)[inside][:, 1]
    expected = np.stack([0.5 + 0.4 * x, 0.5 + 0.4 * y, 0.5 - 0.3 * x * y], -1)
    np.testing.assert_allclose(got[inside], expected, atol=1e-4)
    np.testing.assert_array_equal(got[~inside], 0)


def test_two_lit_spheres_change_over_with_curvature(x64, rng):
    gbuffer, descriptor = ball(x64, rng)
    one, two = painted_ball(x64), jnp.ones((16, 16, 3))
    sharp = np.asarray(se.lit_sphere(gbuffer, one, concave=two, descriptor=descriptor, transition=1e9))
    convex = np.asarray(se.lit_sphere(gbuffer, one))
    hollow = np.asarray(descriptor.hessian[..., 0] + descriptor.hessian[..., 2] > 0) & np.asarray(gbuffer.mask)
    full = ~hollow & np.asarray(gbuffer.mask)
    np.testing.assert_allclose(sharp[hollow], 1, rtol=1e-12)
    np.testing.assert_allclose(sharp[full], convex[full], rtol=1e-12)
    half = np.asarray(se.lit_sphere(gbuffer, one, concave=two, descriptor=descriptor, transition=0.0))
    np.testing.assert_allclose(half[full], 0.5 + 0.5 * convex[full], rtol=1e-12)


# ------------------------------------------------------------------------------------------- bad input


def test_bad_pixels_stay_alone(dtype, rng):
    gbuffer, descriptor = ball(dtype, rng)
    bad = replace(gbuffer, normal=gbuffer.normal.at[12, 12].set(jnp.nan))
    crooked = replace(descriptor, hessian=descriptor.hessian.at[5, 9].set(jnp.nan))
    radiance = smooth_map(dtype)
    for shade in (se.shade_mirror, se.shade_refraction, se.shade_diffuse):
        value, gradient = jax.value_and_grad(
            lambda a, s=shade: jnp.sum(s(bad, radiance, descriptor=crooked, alpha=a, gamma=1.0))
        )(jnp.asarray(2.0, dtype))
        assert np.isfinite(value)
        assert np.isfinite(gradient)


@pytest.mark.parametrize(("bad", "instead"), [(np.nan, 0.0), (-np.inf, 0.0), (np.inf, None)])
def test_bad_pixels_of_a_map_count_as_dark_or_as_the_brightest(bad, instead, dtype, rng):
    gbuffer, _ = ball(dtype, rng)
    clean = np.array(smooth_map(dtype))
    spoilt = clean.copy()
    spoilt[3, 4], spoilt[9, 20, 1] = bad, bad
    clean[3, 4] = clean[9, 20, 1] = np.max(clean) if instead is None else instead
    direction = np.asarray(gbuffer.normal)
    reads = [
        se.prefilter_map,
        se.spherical_harmonics,
        lambda m: se.environment_radiance(m, direction),
        lambda m: se.shade_mirror(gbuffer, m),
        lambda m: se.shade_diffuse(gbuffer, m),
    ]
    for read in reads:
        np.testing.assert_array_equal(jax.jit(read)(spoilt), jax.jit(read)(clean))
        gradient = jax.jit(jax.grad(lambda m, read=read: jnp.sum(read(m))))(jnp.asarray(spoilt))
        assert np.all(np.isfinite(gradient))
        assert np.all(gradient[3, 4] == 0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_bad_pixels_of_a_picture_do_not_set_its_exposure(bad, dtype, rng):
    picture = rng.uniform(0, 1, (6, 8, 3)).astype(dtype)
    mask = np.indices((6, 8)).sum(axis=0) % 3 > 0
    without = mask.copy()
    without[2, 3] = False
    spoilt = picture.copy()
    spoilt[2, 3, 1] = bad
    assert mask[2, 3]
    assert se.auto_exposure(spoilt, mask) == se.auto_exposure(picture, without)
    assert np.all(np.isfinite(jax.grad(se.auto_exposure)(jnp.asarray(spoilt), mask)))


def test_the_tone_curve_of_negative_luminance_is_a_straight_line():
    radiance = -np.linspace(0, 3, 13)[:, None] * np.ones(3, np.float32)
    np.testing.assert_allclose(se.tone_map(radiance, exposure=0.5), 0.5 * radiance, rtol=1e-6)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda g, m: se.shade_mirror(g, m, alpha=1.0), "descriptor is a NoneType"),
        (lambda g, m: se.shade_mirror(g, m[0]), "radiance_map has shape"),
        (lambda g, m: se.shade_mirror(g, m, rotation=np.ones(3)), r"rotation has shape \(3,\)"),
        (lambda g, m: se.shade_refraction(g, m, ior=0.5), "ior is 0.5"),
        (lambda g, m: se.shade_diffuse(g, m, invariant=1.0), "invariant is 1"),
        (lambda g, m: se.shade_phong(g, None), "lights is a NoneType"),
        (lambda g, m: se.shade_phong(g, se.Lights(np.eye(3) * 1e30, np.eye(3))), "3 vector.* another length than 1"),
        (lambda g, m: se.shade_mirror(g, m, alpha="40"), "alpha is '40'; accepted are real numbers"),
        (lambda g, m: se.ashikhmin_shirley(g.normal, g.normal, g.normal, None), "material is a NoneType"),
        (lambda g, m: se.tone_map(m, exposure=np.nan), "exposure is nan"),
        (lambda g, m: se.tone_map(m, exposure=0.0), "exposure is 0"),
        (lambda g, m: se.composite(m, m[..., 0], np.full(3, np.nan)), "background holds 3 NaN"),
        (lambda g, m: se.contrast(m + 1j, m[..., 0] > 0), "image is an array of complex64; accepted are real"),
        (lambda g, m: se.lit_sphere(g, m, concave=m), "descriptor is a NoneType"),
        (lambda g, m: se.ambient_occlusion(g, None, radius=1.0), "camera is a NoneType"),
    ],
)
def test_wrong_arguments_are_named(rng, call, words):
    gbuffer, _ = ball(np.float32, rng)
    with pytest.raises(ValueError, match=words):
        call(gbuffer, smooth_map(np.float32, height=8))
