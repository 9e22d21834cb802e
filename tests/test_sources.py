"""G-buffers from images: normals and heights; decoding; the check of the convention."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import shapeenh as se
from tests.reference import sources as plain


def sphere(size=64, radius=24.0):
    """(normal [size, size, 3] with zeros outside, height with NaN outside, mask) of a hemisphere seen from above."""
    axis = np.arange(size) + 0.5 - size / 2
    x, y = np.broadcast_arrays(axis[None], -axis[:, None])
    inside = x**2 + y**2 < radius**2
    z = np.sqrt(np.where(inside, radius**2 - x**2 - y**2, 0))
    normal = np.where(inside[..., None], np.stack([x, y, z], axis=-1) / radius, 0)
    return normal, np.where(inside, z, np.nan), inside


def saddle(h, w):
    """Heights with twist in every direction, and their exact gradient (y up)."""
    y, x = np.meshgrid(-(np.arange(h) + 0.5 - h / 2), np.arange(w) + 0.5 - w / 2, indexing="ij")
    height = 0.01 * x * y + 2 * np.sin(x / 6) * np.cos(y / 5) + 0.002 * x**2
    zx = 0.01 * y + 2 / 6 * np.cos(x / 6) * np.cos(y / 5) + 0.004 * x
    zy = 0.01 * x - 2 / 5 * np.sin(x / 6) * np.sin(y / 5)
    return height, zx, zy


def normals_of(zx, zy):
    n = np.stack([-zx, -zy, np.ones_like(zx)], axis=-1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


# ------------------------------------------------------------------------------------------- normals


def test_normals_are_kept_and_the_rest_filled_in(dtype):
    normal, _, inside = sphere()
    g = se.gbuffer_from_normals(normal.astype(dtype) * 3, spacing=(0.5, 0.25))
    assert g.normal.dtype == g.depth.dtype == g.position.dtype == dtype
    assert np.array_equal(g.mask, inside)
    held = normal[..., 2] < 0.01
    np.testing.assert_allclose(np.asarray(g.normal)[~held], normal[~held], atol=1e-6)
    assert np.all(np.asarray(g.depth) == inside)  # 1 on the mask, 0 off it
    row, column = 20, 40
    np.testing.assert_allclose(g.position[row, column], [(40.5 - 32) * 0.5, (32 - 20.5) * 0.25, -1], rtol=1e-6)
    assert np.all(np.asarray(g.position)[~inside] == 0)
    assert g.albedo is None
    assert g.occlusion is None


def test_depth_mask_occlusion_and_albedo(rng):
    normal, height, inside = sphere()
    depth = np.where(inside, 100 - np.nan_to_num(height), np.nan)
    depth[30, 30], depth[31, 31] = np.inf, -1
    mask = np.arange(64)[None] * np.ones((64, 1)) > 20
    occlusion, albedo = rng.random((64, 64)), rng.random((64, 64, 3))
    occlusion[40, 40] = np.nan
    g = se.gbuffer_from_normals(normal, depth=depth, mask=mask, occlusion=occlusion, albedo=albedo)
    expected = inside & mask & np.isfinite(depth) & (depth > 0)
    assert np.array_equal(g.mask, expected)
    np.testing.assert_allclose(np.asarray(g.depth)[expected], depth[expected], rtol=1e-6)
    np.testing.assert_allclose(np.asarray(g.position)[..., 2], -np.asarray(g.depth))
    assert g.occlusion[40, 40] == 1
    assert np.all(np.asarray(g.occlusion)[~expected] == 1)
    np.testing.assert_allclose(g.occlusion[35, 35], occlusion[35, 35], rtol=1e-6)
    assert np.all(np.asarray(g.albedo)[~expected] == 0)
    whole = se.gbuffer_from_normals(normal, occlusion=np.full((64, 64), 128, np.uint8))
    np.testing.assert_allclose(whole.occlusion[35, 35], 128 / 255, rtol=1e-6)


def test_without_depth_there_are_no_silhouettes_but_those_of_the_occlusion_map():
    normal, _, inside = sphere()
    occlusion = np.ones((64, 64))
    occlusion[:, 30:33] = 0
    none = se.describe(se.gbuffer_from_normals(normal))
    assert float(none.silhouette.max()) == 0
    some = se.describe(se.gbuffer_from_normals(normal, occlusion=occlusion))
    assert np.array_equal(np.asarray(some.silhouette) == 1, (occlusion == 0) & inside)


def test_bad_pixels_poison_nobody(rng):
    normal, _, inside = sphere()
    bad = rng.random((64, 64)) < 0.1
    values = np.array([np.nan, np.inf, -np.inf])
    broken = np.where(bad[..., None], rng.choice(values, (64, 64, 3)), normal)
    g = se.gbuffer_from_normals(broken)
    assert np.array_equal(g.mask, inside & ~bad)
    assert all(bool(jnp.isfinite(a).all()) for a in (g.normal, g.depth, g.position))
    good = np.asarray(g.mask) & (normal[..., 2] > 0.01)
    np.testing.assert_allclose(np.asarray(g.normal)[good], normal[good], atol=1e-6)

    def loss(n):
        return jnp.sum(se.gbuffer_from_normals(n).normal * jnp.arange(3.0)[None, None])

    grad = np.asarray(jax.grad(loss)(jnp.asarray(broken, jnp.float32)))
    assert np.isfinite(grad).all()
    assert np.all(grad[~np.asarray(g.mask)] == 0)


def test_normals_that_look_away_are_held_at_grazing(dtype):
    n = np.array([[[0.6, 0.0, 0.8], [0.6, 0.0, -0.8], [1.0, 0, 0], [0, 0, -1.0]]], dtype)
    g = se.gbuffer_from_normals(n, check=False)
    got = np.asarray(g.normal)[0]
    np.testing.assert_allclose(np.linalg.norm(got, axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose(got[0], [0.6, 0, 0.8], atol=1e-6)
    assert np.all(got[:, 2] > 0.0099)
    np.testing.assert_allclose(got[1], np.array([0.6, 0, 0.01]) / np.hypot(0.6, 0.01), atol=1e-6)


# ------------------------------------------------------------------------------------------- decoding


def test_decoding_16_bits_keeps_the_curvature():
    normal, _, inside = sphere()
    stored = np.where(inside[..., None], np.round((normal + 1) / 2 * 65535), 0).astype(np.uint16)
    n = np.asarray(se.decode_normals(stored))
    assert np.all(n[~inside] == 0)
    np.testing.assert_allclose(n[inside], normal[inside], atol=3e-5)
    exact = se.mean_curvature(se.describe(se.gbuffer_from_normals(normal)).hessian)
    got = se.mean_curvature(se.describe(se.gbuffer_from_normals(stored)).hessian)
    inner = normal[..., 2] > 0.5
    np.testing.assert_allclose(np.asarray(got)[inner], np.asarray(exact)[inner], rtol=0.02)


def test_decoding_8_bits_warns_and_green_down_flips_y():
    normal, _, inside = sphere()
    stored = np.where(inside[..., None], np.round((normal + 1) / 2 * 255), 0).astype(np.uint8)
    with pytest.warns(UserWarning, match="8-bit normals") as caught:
        up = np.asarray(se.decode_normals(stored))
    assert caught[0].filename == __file__
    np.testing.assert_allclose(up[inside], normal[inside], atol=0.008)
    flipped = stored.copy()
    flipped[..., 1] = np.where(inside, 255 - stored[..., 1], 0)
    with pytest.warns(UserWarning, match="8-bit normals"):
        down = np.asarray(se.decode_normals(flipped, green="down"))
    np.testing.assert_allclose(down, up, atol=1e-6)
    with pytest.warns(UserWarning, match="8-bit normals") as caught:
        g = se.gbuffer_from_normals(flipped, green="down")
    assert caught[0].filename == __file__
    assert np.array_equal(g.mask, inside)


def test_decoding_alpha_and_floats():
    normal, _, inside = sphere()
    color = (normal + 1) / 2
    rgba = np.concatenate([color, inside[..., None]], axis=-1).astype(np.float32)
    n = np.asarray(se.decode_normals(rgba))
    assert np.all(n[~inside] == 0)
    np.testing.assert_allclose(n[inside], normal[inside], atol=1e-5)
    color[5, 5] = np.nan
    assert np.all(np.asarray(se.decode_normals(color))[5, 5] == 0)


# ------------------------------------------------------------------------------------------- the convention


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_the_wrong_green_is_noticed_and_the_right_one_is_not(noise, rng):
    _, zx, zy = saddle(64, 64)
    scenes = [sphere()[0], normals_of(zx, zy)]
    for normal in scenes:
        normal = normal + noise * rng.normal(size=normal.shape) * (np.abs(normal).sum(-1, keepdims=True) > 0)
        wrong = normal * np.array([1, -1, 1])
        se.gbuffer_from_normals(normal)
        se.gbuffer_from_normals(wrong, green="down")
        with pytest.warns(UserWarning, match="fits no surface with green up.*try green='down'"):
            se.gbuffer_from_normals(wrong)
        with pytest.warns(UserWarning, match="try green='up'"):
            se.gbuffer_from_normals(normal, green="down")
        se.gbuffer_from_normals(wrong, check=False)


def test_no_verdict_without_evidence(rng):
    """Planes, cylinders, noise, and pictures of a few pixels say nothing about green."""
    x = np.linspace(-0.9, 0.9, 64)
    cylinder = np.broadcast_to(np.stack([x, 0 * x, np.sqrt(1 - x**2)], axis=-1)[None], (64, 64, 3))
    noise = rng.normal(size=(64, 64, 3)) * 0.1 + np.array([0, 0, 1.0])
    few = np.zeros((64, 64, 3))
    few[30:36, 30:36] = sphere()[0][30:36, 30:36]
    for normal in (np.tile([0.3, 0.2, 0.93], (64, 64, 1)), cylinder, noise, few):
        for green in ("up", "down"):
            se.gbuffer_from_normals(normal, green=green)


def test_colours_and_turned_axes_are_noticed():
    normal, _, _ = sphere()
    with pytest.warns(UserWarning, match="looks like colours"):
        se.gbuffer_from_normals((normal + 1) / 2)
    with pytest.warns(UserWarning, match="z < 0 at"):
        se.gbuffer_from_normals(normal * np.array([1, 1, -1]))


def test_the_check_is_silent_under_jit():
    normal = jnp.asarray(sphere()[0] * np.array([1, -1, 1]), jnp.float32)
    jax.jit(se.gbuffer_from_normals)(normal)


# ------------------------------------------------------------------------------------------- heights


def test_heights_of_second_order_are_exact_to_the_border(dtype, rng):
    """Central and one-sided differences are exact for quadratics: normals are the surface's own, at every pixel."""
    a = rng.normal(size=5) * 0.02
    dx, dy = 0.5, 2.0
    y, x = np.meshgrid((9 / 2 - np.arange(9) - 0.5) * dy, (np.arange(12) + 0.5 - 6) * dx, indexing="ij")
    height = a[0] * x**2 + a[1] * x * y + a[2] * y**2 + a[3] * x + a[4] * y
    exact = normals_of(2 * a[0] * x + a[1] * y + a[3], a[1] * x + 2 * a[2] * y + a[4])
    g = se.gbuffer_from_height(height.astype(dtype), spacing=(dx, dy))
    np.testing.assert_allclose(g.normal, exact, atol=3e-6 if dtype == np.float32 else 1e-12)
    assert bool(g.mask.all())
    np.testing.assert_allclose(g.position[..., 0], x, atol=1e-6)
    np.testing.assert_allclose(g.position[..., 1], y, atol=1e-6)
    np.testing.assert_allclose(g.position[..., 2] - g.position[0, 0, 2], height - height[0, 0], atol=1e-5)
    assert float(g.depth.min()) == 2.0  # the highest point lies one pixel below the plane


def test_heights_with_holes_agree_with_the_twin(x64, rng):
    height, _, _ = saddle(11, 13)
    holes = rng.random(height.shape) < 0.3
    g = se.gbuffer_from_height(np.where(holes, np.nan, height))
    n = np.asarray(g.normal)
    for axis, component in ((0, 1), (1, 0)):
        for r, c in np.ndindex(height.shape):
            if holes[r, c]:
                continue
            line, valid, at = (height[:, c], ~holes[:, c], r) if axis == 0 else (height[r], ~holes[r], c)
            expected = plain.slope(line, valid, at) or 0.0
            np.testing.assert_allclose(
                -n[r, c, component] / n[r, c, 2], -expected if axis == 0 else expected, atol=1e-12
            )


def test_second_order_convergence_up_to_the_border(x64):
    errors = []
    for k in (1, 2, 4):
        h, w = 20 * k, 24 * k
        y, x = np.meshgrid(10 - (np.arange(h) + 0.5) / k, (np.arange(w) + 0.5) / k - 12, indexing="ij")
        g = se.gbuffer_from_height(2 * np.sin(x / 6) * np.cos(y / 5), spacing=1 / k)
        exact = normals_of(2 / 6 * np.cos(x / 6) * np.cos(y / 5), -2 / 5 * np.sin(x / 6) * np.sin(y / 5))
        errors.append(np.abs(np.asarray(g.normal) - exact).max())
    assert errors[0] / errors[1] > 3.5
    assert errors[1] / errors[2] > 3.5


def test_spacing_and_z_factor(rng):
    height, _, _ = saddle(9, 10)
    a = se.gbuffer_from_height(height, spacing=2.0, z_factor=3.0)
    b = se.gbuffer_from_height(3 * height / 2)
    np.testing.assert_allclose(a.normal, b.normal, atol=1e-5)
    np.testing.assert_allclose(a.position, 2 * b.position, atol=2e-5)
    c = se.gbuffer_from_height(height + 55)
    np.testing.assert_allclose(c.depth, se.gbuffer_from_height(height).depth, atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "nodata"), [("f4", -9999), ("f8", -9999.0), ("i2", -32768), ("u2", 0), ("f4", -3.4028234663852886e38)]
)
def test_nodata(kind, nodata):
    height = (100 + 20 * saddle(12, 14)[0]).astype(kind)
    hole = np.zeros((12, 14), bool)
    hole[3:5, 6:9] = hole[0, 0] = True
    stored = np.where(hole, np.asarray(nodata, np.dtype(kind)), height)
    for heights in (stored, jnp.asarray(stored)):
        g = se.gbuffer_from_height(heights, nodata=nodata)
        assert np.array_equal(g.mask, ~hole)
        assert np.all(np.asarray(g.depth)[hole] == 0)
        assert np.all(np.asarray(g.normal)[hole] == 0)
        as_nan = se.gbuffer_from_height(np.where(hole, np.nan, height.astype(float)))
        np.testing.assert_allclose(g.normal, as_nan.normal, atol=1e-5)
    if kind == "u2":
        assert bool(se.gbuffer_from_height(height, nodata=-9999).mask.all())  # a value that cannot occur


def test_eight_bit_heights_warn_with_the_sigma_that_helps():
    with pytest.warns(UserWarning, match="sigma of 2") as caught:
        se.gbuffer_from_height(np.arange(12, dtype=np.uint8).reshape(3, 4))
    assert caught[0].filename == __file__


def test_a_large_offset_costs_nothing():
    """Elevations of kilometres with a relief of millimetres, in float64 files and without x64."""
    height, _, _ = saddle(20, 20)
    flat = se.gbuffer_from_height(height * 1e-3, spacing=1e-3)
    high = se.gbuffer_from_height(height * 1e-3 + 4810.0, spacing=1e-3)
    assert high.normal.dtype == np.float32
    np.testing.assert_allclose(high.normal, flat.normal, atol=1e-4)


def test_torn_surfaces():
    """A plateau before a background: with max_slope both sides are flat, and the step is a silhouette."""
    height = np.zeros((20, 30))
    height[5:15, 10:20] = 40.0
    whole = se.gbuffer_from_height(height)
    assert float(whole.normal[10, 10, 2]) < 0.1
    torn = se.gbuffer_from_height(height, max_slope=10.0)
    np.testing.assert_allclose(torn.normal, np.broadcast_to([0, 0, 1.0], (20, 30, 3)), atol=1e-7)
    silhouette = np.asarray(se.describe(torn).silhouette)
    assert np.all(silhouette[5:15, 9] == 1)  # the far side of the step
    assert np.all(silhouette[5:15, 10:20] == 0)
    assert np.array_equal(se.gbuffer_from_height(height, max_slope=41.0).normal, whole.normal)


# ------------------------------------------------------------------------------------------- edge cases


@jax.jit
def value_and_gradients(height, spacing):
    def loss(height, spacing):
        g = se.gbuffer_from_height(height, spacing=spacing)
        return jnp.sum(g.normal * jnp.arange(3.0)[None, None]) + jnp.sum(g.depth) * 1e-30, g

    (_, g), grads = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)(height, spacing)
    return g, grads


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    st.sampled_from([(1, 1), (1, 5), (5, 1), (4, 5)]),
    st.lists(st.sampled_from([0.0, 1.0, -2.5, 1e9, -1e9, 3e38, np.nan, np.inf, 1e-30]), min_size=20, max_size=20),
    st.sampled_from([1e-9, 1.0, 1e9]),
)
def test_any_heights_give_finite_buffers_and_gradients(shape, values, spacing):
    height = jnp.asarray(np.array(values[: shape[0] * shape[1]]).reshape(shape), jnp.float32)
    g, grads = value_and_gradients(height, jnp.asarray(spacing, jnp.float32))
    mask = np.asarray(g.mask)
    assert np.array_equal(mask, np.abs(np.asarray(height)) <= 1e9)
    for field in (g.normal, g.depth, g.position, *grads):
        assert bool(jnp.isfinite(field).all())
    np.testing.assert_allclose(np.linalg.norm(np.asarray(g.normal), axis=-1)[mask], 1, atol=1e-5)
    assert np.all(np.asarray(g.depth)[mask] > 0)


def test_nothing_there():
    for g in (se.gbuffer_from_height(np.full((3, 4), np.nan)), se.gbuffer_from_normals(np.zeros((3, 4, 3)))):
        assert not bool(g.mask.any())
        assert all(not np.any(np.asarray(a)) for a in (g.normal, g.depth, g.position))


def test_jit_and_vmap_agree():
    heights = jnp.stack([jnp.asarray(saddle(8, 9)[0], jnp.float32) * k for k in (1, 2)])
    batch = jax.vmap(se.gbuffer_from_height)(heights)
    normal = jnp.asarray(sphere()[0], jnp.float32)
    images = jax.vmap(se.gbuffer_from_normals)(jnp.stack([normal, normal[::-1]]))
    np.testing.assert_allclose(images.normal[0], se.gbuffer_from_normals(normal).normal, atol=1e-6)
    for k in range(2):
        one = se.gbuffer_from_height(heights[k])
        np.testing.assert_allclose(batch.normal[k], one.normal, atol=1e-6)
        np.testing.assert_allclose(jax.jit(se.gbuffer_from_height)(heights[k]).depth, one.depth, atol=1e-5)


def test_errors():
    n, h = np.tile([0, 0, 1.0], (4, 5, 1)), np.zeros((4, 5))
    cases = [
        (se.gbuffer_from_normals, (h,), {}, "normal has shape"),
        (se.gbuffer_from_normals, (n.astype(int),), {}, "normal has dtype int64; accepted are floats, uint8"),
        (se.gbuffer_from_normals, (n[:0],), {}, "at least one pixel"),
        (se.gbuffer_from_normals, (n,), {"depth": h[:3]}, "depth has shape"),
        (se.gbuffer_from_normals, (n,), {"depth": np.ones((4, 5), int)}, "depth has dtype int64"),
        (se.gbuffer_from_normals, (n,), {"mask": h[:, :2]}, "mask has shape"),
        (se.gbuffer_from_normals, (n,), {"occlusion": n}, "occlusion has shape"),
        (se.gbuffer_from_normals, (n,), {"albedo": np.zeros((4, 5, 3), np.uint8)}, "albedo has dtype uint8"),
        (se.gbuffer_from_normals, (n,), {"green": "left"}, "green is 'left'"),
        (se.gbuffer_from_normals, (n,), {"spacing": 0}, "spacing is 0"),
        (se.gbuffer_from_normals, (n,), {"spacing": (1, 2, 3)}, r"spacing has shape \(3,\)"),
        (se.gbuffer_from_height, (n,), {}, "height has shape"),
        (se.gbuffer_from_height, (h[:0],), {}, "at least one pixel"),
        (se.gbuffer_from_height, (h.astype(complex),), {}, "height has dtype complex128"),
        (se.gbuffer_from_height, (h,), {"z_factor": -1}, "z_factor is -1"),
        (se.gbuffer_from_height, (h,), {"max_slope": 0}, "max_slope is 0"),
        (se.gbuffer_from_height, (h,), {"spacing": np.inf}, "spacing is inf"),
        (se.decode_normals, (h,), {}, "image has shape"),
        (se.decode_normals, (n.astype(int),), {}, "image has dtype int64"),
        (se.decode_normals, (n,), {"green": ""}, "green is ''"),
    ]
    for function, arrays, options, message in cases:
        with pytest.raises(ValueError, match=message):
            function(*arrays, **options)
