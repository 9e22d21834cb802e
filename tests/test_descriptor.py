"""SPEC 3: the view-centred descriptor against closed forms, its laws, gradients and edge cases."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shapeenh as se
from shapeenh.descriptor.box import covering_part
from shapeenh.types import replace
from tests.reference import descriptor as reference


def buffer(fields, dtype=np.float64, **more):
    floats = {k: jnp.asarray(v, dtype) for k, v in {**fields, **more}.items() if k != "mask"}
    return se.GBuffer(mask=jnp.asarray(fields["mask"]), **floats)


def relative_error(got, wanted):
    size = np.linalg.norm(wanted, axis=-1)
    return np.linalg.norm(np.asarray(got, np.float64) - wanted, axis=-1) / np.where(size > 0, size, 1)


def distance_inside(mask):
    from scipy.ndimage import distance_transform_edt

    return distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]


SIZE = (60, 80)

# ------------------------------------------------------------------------------------------- closed forms


def test_waves_to_one_percent(dtype):
    """Median error at most 1 % on waves of 64 px (SPEC 3); in either precision."""
    fields, hessian = reference.waves(120, 160)
    got = se.describe(buffer(fields, dtype)).hessian
    assert got.dtype == dtype
    assert np.median(relative_error(got, hessian)) <= 0.01


@pytest.mark.parametrize("surface", ["waves", "torus"])
def test_second_order_in_resolution(x64, surface):
    """Half the pixel: a quarter of the error, and half the curvature per pixel."""
    errors = []
    for n in (1, 2):
        h, w = 60 * n, 80 * n
        if surface == "waves":
            fields, hessian = reference.waves(h, w, wavelength=40.0 * n, amplitude=4.0 * n)
        else:
            fields, hessian = reference.torus(h, w, 18.0 * n, 9.0 * n)
        on = distance_inside(fields["mask"]) > 3 * n
        errors.append(np.median(relative_error(se.describe(buffer(fields)).hessian, hessian)[on]))
    assert 3.4 < errors[0] / errors[1] < 4.6


@pytest.mark.parametrize("name", ["disc of waves", "paraboloid", "sphere", "torus"])
def test_accurate_up_to_the_outline(x64, name):
    """Within three pixels of the outline the error stays within ten times the interior's (or below 1e-9)."""
    x, y = reference.pixel_grid(*SIZE)
    disc = np.hypot(x, y) < 27
    fields, hessian = {
        "disc of waves": lambda: reference.waves(*SIZE, mask=disc),
        "paraboloid": lambda: reference.paraboloid(*SIZE, mask=disc),
        "sphere": lambda: reference.sphere(*SIZE, 28.3),
        "torus": lambda: reference.torus(*SIZE, 18.0, 9.0),
    }[name]()
    error = relative_error(se.describe(buffer(fields)).hessian, hessian)
    inside = distance_inside(fields["mask"])
    rim, interior = (inside > 0) & (inside <= 3), inside > 3
    assert np.sqrt(np.mean(error[rim] ** 2)) <= 10 * np.sqrt(np.mean(error[interior] ** 2)) + 1e-9


@pytest.mark.parametrize("sigma", [2.5, 8.0])
def test_diffusion_leaves_no_rim(x64, sigma):
    """A paraboloid keeps its constant curvature up to its outline, whatever sigma: no dark or bright rim."""
    x, y = reference.pixel_grid(*SIZE)
    fields, hessian = reference.paraboloid(*SIZE, mask=np.hypot(x, 1.3 * y) < 27)
    error = relative_error(se.describe(buffer(fields), sigma=sigma).hessian, hessian)[fields["mask"]]
    assert np.max(error) < 0.02


def test_signs_and_principal_curvatures(x64):
    fields, _ = reference.sphere(*SIZE, 28.3)
    h = se.describe(buffer(fields)).hessian
    k1, k2 = se.principal_curvatures(h)
    on = fields["mask"]
    assert (np.asarray(se.mean_curvature(h))[on] < 0).all()  # convex is negative
    assert (np.asarray(k1) >= np.asarray(k2)).all()
    np.testing.assert_allclose(se.mean_curvature(h), 0.5 * (k1 + k2), atol=1e-12)
    np.testing.assert_allclose(se.gaussian_curvature(h)[on], (k1 * k2)[on], rtol=1e-9)
    fields, hessian = reference.paraboloid(*SIZE, hessian=(-0.01, 0.02, 0.005))  # xy > 0: y points up
    got = np.asarray(se.describe(buffer(fields)).hessian)
    np.testing.assert_allclose(np.median(got, (0, 1)), hessian[0, 0], rtol=2e-2)


def test_foreshortening(x64):
    fields, _ = reference.sphere(*SIZE, 28.3)
    n = fields["normal"]
    for f in (0.0, 0.5, 1.0, 2.0):
        got = np.asarray(se.describe(buffer(fields), foreshortening=f).gradient)
        wanted = -n[..., :2] / np.where(fields["mask"], n[..., 2], 1)[..., None] ** f
        np.testing.assert_allclose(got, wanted, rtol=1e-10, atol=1e-12)
    flat = np.asarray(se.describe(buffer(fields), foreshortening=0.0).hessian)
    np.testing.assert_allclose(flat[fields["mask"]] * 28.3, np.tile([-1, 0, -1], (fields["mask"].sum(), 1)), atol=1e-9)


def test_turning_and_zooming(x64):
    """A quarter turn of the image turns the tensor; twice the pixels show half the curvature."""
    fields, _ = reference.waves(64, 64)
    h = np.asarray(se.describe(buffer(fields), sigma=2.0).hessian)
    turned = {k: np.rot90(v).copy() for k, v in fields.items()}
    for k in ("normal", "position"):
        v = turned[k]
        turned[k] = np.stack([-v[..., 1], v[..., 0], v[..., 2]], -1)
    t = np.asarray(se.describe(buffer(turned), sigma=2.0).hessian)
    back = np.rot90(h)
    np.testing.assert_allclose(t, np.stack([back[..., 2], -back[..., 1], back[..., 0]], -1), atol=1e-10)


# ------------------------------------------------------------------------------------------- silhouettes and creases


def two_planes(slope, step, *, fov=0.0, spacing=1.0):
    """A plane of the given slope with a step of `step` pixels along its middle column, orthographic or perspective."""
    x, y = reference.pixel_grid(*SIZE, spacing)
    far = x > 0
    if not fov:
        z = slope * x - np.where(far, step * spacing, 0)
        fields = reference.from_height(x, y, z, np.full_like(x, slope), np.zeros_like(x))
        return fields
    pitch = 2 * np.tan(np.deg2rad(fov) / 2) / SIZE[0]
    u, v = reference.pixel_grid(*SIZE, pitch)
    depth = (1 + np.where(far, step * pitch, 0)) / (1 + slope * u)  # the plane z = -1 + slope x, seen along (u, v, -1)
    n = np.array([-slope, 0, 1]) / np.hypot(1, slope)
    position = np.stack([u * depth, v * depth, -depth], -1)
    return {
        "mask": np.ones(SIZE, bool),
        "depth": depth,
        "normal": np.broadcast_to(n, (*SIZE, 3)),
        "position": position,
    }


@pytest.mark.parametrize("fov", [0.0, 20.0])
@pytest.mark.parametrize("slope", [0.0, 1.0, -1.0])
def test_steps_are_silhouettes_and_slopes_are_not(x64, slope, fov):
    middle = SIZE[1] // 2
    w = np.asarray(se.describe(buffer(two_planes(slope, 0.0, fov=fov))).silhouette)
    assert not w.any()
    for step in (2.0, 8.0, 40.0):
        w = np.asarray(se.describe(buffer(two_planes(slope, step, fov=fov))).silhouette)
        assert (w[:, middle] == 1).all()  # the far side, and nothing else
        assert not np.delete(w, middle, axis=1).any()


def test_steep_smooth_surfaces_have_no_silhouettes(x64):
    for fields, _ in (
        reference.sphere(*SIZE, 28.3),
        reference.torus(*SIZE, 18.0, 9.0),
        reference.waves(*SIZE, wavelength=20.0, amplitude=15.0),
        reference.paraboloid(*SIZE, hessian=(-0.3, 0.0, 0.3)),
    ):
        assert not (np.asarray(se.describe(buffer(fields)).silhouette) > 0.5).any()


def test_one_sphere_before_another(x64):
    fields, index = reference.traced_spheres(*SIZE, [((0, 0, -5), 1.0), ((0.8, 0.3, -6.5), 1.4)])
    w = np.asarray(se.describe(buffer(fields)).silhouette)
    seam = (index[:, 1:] >= 0) & (index[:, :-1] >= 0) & (index[:, 1:] != index[:, :-1])
    far = np.zeros(SIZE, bool)
    far[:, 1:] |= seam & (index[:, 1:] == 1)
    far[:, :-1] |= seam & (index[:, :-1] == 1)
    assert far.sum() > 15
    assert (w[far] > 0.9).mean() > 0.95
    assert not w[index == 0].any()
    assert (w > 0.5).sum() < 2 * far.sum() + 10


def test_nothing_leaks_across_a_silhouette():
    """Other normals on the far side change nothing in front, through diffusion and derivatives (1e-6)."""
    fields = two_planes(0.0, 10.0)
    middle = SIZE[1] // 2
    other = {**fields, "normal": fields["normal"].copy()}
    rng = np.random.default_rng(1)
    n = rng.standard_normal((SIZE[0], SIZE[1] - middle, 3)) * 0.2 + [0, 0, 1]
    other["normal"][:, middle:] = n / np.linalg.norm(n, axis=-1, keepdims=True)
    for scheme in ("explicit", "fast"):
        a, b = (se.describe(buffer(f, np.float32), sigma=5.0, scheme=scheme) for f in (fields, other))
        for name in ("hessian", "gradient"):
            x, y = (np.asarray(getattr(d, name))[:, :middle] for d in (a, b))
            np.testing.assert_allclose(x, y, atol=1e-6)


def test_without_depth_silhouettes_come_from_occlusion(x64):
    fields, _ = reference.waves(*SIZE)
    occlusion = np.ones(SIZE)
    occlusion[:, 30] = 0.1
    flat = {**fields, "depth": np.ones(SIZE), "position": np.zeros((*SIZE, 3))}
    assert not np.asarray(se.describe(buffer(flat)).silhouette).any()
    w = np.asarray(se.describe(buffer(flat, occlusion=occlusion)).silhouette)
    assert (w[:, 30] == 1).all()
    assert not np.delete(w, 30, axis=1).any()


def test_creases_only_when_asked_for(x64):
    x, y = reference.pixel_grid(*SIZE)
    fields = reference.from_height(x, y, -np.abs(x), -np.sign(x), np.zeros_like(x))  # a right-angled roof
    plain, sharp = se.describe(buffer(fields)), se.describe(buffer(fields), creases=True)
    assert not np.asarray(plain.crease).any()
    middle = SIZE[1] // 2
    w = np.asarray(sharp.crease)
    assert (w[:, middle - 1 : middle + 1] == 1).all()
    assert not np.delete(w, [middle - 1, middle], axis=1).any()
    assert not np.asarray(sharp.hessian).any()  # two flat sides, and singular between
    assert not np.asarray(se.describe(buffer(fields), creases=130.0).crease).any()
    assert not np.asarray(plain.silhouette).any()  # a sharp edge is no step


# ------------------------------------------------------------------------------------------- scale and importance


def test_skipping_does_not_change_the_result(x64):
    fields, _ = reference.traced_spheres(*SIZE, [((0, 0, -5), 1.0), ((0.8, 0.3, -5.9), 1.4)])
    g = buffer(fields)
    c = np.asarray(se.describe(g).conductance)
    assert np.any((c > 0.1) & (c < 0.9))  # some pixels are insulated in part only
    general = jax.jit(lambda g, s, f: se.describe(g, sigma=s, foreshortening=f))
    for sigma in (0.0, 7.0):
        a, b = se.describe(g, sigma=sigma), general(g, sigma, 1.0)
        np.testing.assert_allclose(a.hessian, b.hessian, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(a.gradient, b.gradient, rtol=1e-7, atol=1e-9)


def test_only_the_fields_asked_for_are_made(x64):
    fields, _ = reference.traced_spheres(*SIZE, [((0, 0, -5), 1.0), ((0.8, 0.3, -5.9), 1.4)])
    g = buffer(fields)
    whole = se.describe(g, sigma=3.0)
    for names in (("hessian",), ("crease", "silhouette"), ()):
        found = se.describe(g, sigma=3.0, fields=names)
        for name in ("hessian", "gradient", "silhouette", "crease", "conductance"):
            if name in names:
                np.testing.assert_allclose(getattr(found, name), getattr(whole, name), atol=1e-12)
            else:
                assert getattr(found, name) is None
    with pytest.raises(ValueError, match=r"descriptor\.hessian is None"):
        se.shade_warped(
            g,
            se.describe(g, fields=("crease",)),
            se.Lights(np.eye(3), np.ones((3, 3))),
            se.named_material("stone"),
            alpha=1.0,
        )


def test_only_the_part_that_holds_the_object_is_worked_on(x64, compilations):
    """In a large image with a small object: the same result as where the mask is not known, 0 around it, and the same
    code wherever the object is."""
    large, _ = reference.traced_spheres(300, 440, [((-0.6, 0.3, -9), 1.0), ((-0.2, 0.5, -10.5), 1.2)])
    g = buffer(large)
    for sigma in (0.0, 3.0):
        a = se.describe(g, sigma=jnp.asarray(sigma))  # as an array, too, it is read
        b = jax.jit(lambda g, sigma=sigma: se.describe(g, sigma=sigma))(g)
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
            assert not np.asarray(x)[~large["mask"]].any()
            np.testing.assert_allclose(x, y, atol=1e-8)
    compilations.clear()
    se.describe(jax.tree.map(lambda a: jnp.roll(a, (40, 60), (0, 1)), g), sigma=jnp.asarray(3.0))
    assert not [name for name in compilations if "describe" in name]


def test_the_part_holds_the_object_wherever_it_is(rng):
    for shape in ((403, 397), (360, 368), (2, 70000)):
        parts = 0
        for _ in range(40):
            (top, bottom), (left, right) = (np.sort(rng.integers(0, n, 2)) for n in shape)
            mask = np.zeros(shape, bool)
            mask[[top, bottom], [left, right]] = True
            part = covering_part(mask)
            if part is None:
                continue
            (row, column), (height, width) = part
            assert 0 <= row <= top
            assert 0 <= column <= left
            assert bottom < row + height <= shape[0]
            assert right < column + width <= shape[1]
            assert row % 4 == column % 4 == 0
            parts += 1
        assert parts > 10  # else this test shows nothing


def test_importance_counts_steps(x64):
    fields, _ = reference.waves(*SIZE, wavelength=16.0)
    g = buffer(fields)
    steps = np.zeros(SIZE)
    steps[:, 40:] = 10
    a = se.describe(g, importance=jnp.asarray(steps))
    raw, smooth = se.describe(g), se.describe(g, sigma=2.0, scheme="explicit")
    np.testing.assert_array_equal(a.gradient[:, :40], raw.gradient[:, :40])
    np.testing.assert_allclose(a.gradient[:, 52:], smooth.gradient[:, 52:], atol=1e-9)  # 10 steps of 1/5: sigma 2
    capped = se.describe(g, sigma=2.0, importance=jnp.full(SIZE, 1e4))
    np.testing.assert_allclose(capped.hessian, smooth.hessian, atol=1e-12)


# ------------------------------------------------------------------------------------------- gradients


def test_principal_directions(x64, rng):
    h = jnp.asarray(rng.standard_normal((50, 3)))
    u, v = se.principal_directions(h)
    k1, k2 = se.principal_curvatures(h)
    matrix = np.stack([h[:, 0], h[:, 1], h[:, 1], h[:, 2]], -1).reshape(-1, 2, 2)
    for t, k in ((u, k1), (v, k2)):
        np.testing.assert_allclose(np.einsum("nij,nj->ni", matrix, t), np.asarray(k)[:, None] * t, atol=1e-10)
        np.testing.assert_allclose(np.linalg.norm(t, axis=-1), 1)
    assert (np.asarray(u)[:, 0] >= 0).all()
    from jax.test_util import check_grads

    check_grads(lambda h: se.principal_directions(h), (h,), order=1, modes=["rev"], rtol=1e-5, atol=1e-5)
    for umbilic in ([0.0, 0, 0], [0.3, 0, 0.3], [1e30, 0, 1e30]):
        grad = jax.grad(lambda h: jnp.sum(jnp.stack(se.principal_directions(h))))(jnp.asarray(umbilic))
        assert not np.asarray(grad).any()
        assert np.array_equal(se.principal_directions(jnp.asarray(umbilic))[0], [1, 0])


def test_borders_of_fusion_outlast_constants():
    """A loss may close over all but one number; the borders between stages are not folded away with the constants."""
    gbuffer = buffer(reference.waves(24, 32)[0], np.float32)

    def loss(foreshortening):
        return jnp.sum(se.describe(gbuffer, sigma=2.0, foreshortening=foreshortening).hessian ** 2)

    for function in (loss, jax.grad(loss)):
        assert jax.jit(function).lower(0.5).compile().as_text().count(" conditional(") > 0


@pytest.mark.slow
@pytest.mark.parametrize("axes", [(0, None), pytest.param((None, 0), marks=pytest.mark.thorough)])
def test_gradients_of_a_batch_are_those_of_its_members(x64, axes):
    """In normals with one sigma, in sigma with one field of normals: each has its own steps, flanks and tiles."""
    fields, _ = reference.traced_spheres(24, 32, [((0, 0, -5), 1.0), ((0.8, 0.3, -5.9), 1.4)])
    gbuffer = buffer(fields)

    @jax.jit
    def gradients(normal, sigma):
        def value(normal, sigma):
            descriptor = se.describe(replace(gbuffer, normal=normal), sigma=sigma)
            return jnp.sum(descriptor.hessian**2), descriptor.silhouette

        (_, silhouette), found = jax.value_and_grad(value, (0, 1), has_aux=True)(normal, sigma)
        return found, silhouette

    several = jnp.stack([gbuffer.normal, gbuffer.normal * jnp.asarray([[[0.9, 1.0, 1.0]]])]), jnp.asarray([0.6, 2.4])
    given = [batch if axis == 0 else batch[1] for batch, axis in zip(several, axes, strict=True)]
    together, silhouette = jax.jit(jax.vmap(gradients, axes))(*given)
    assert np.any((silhouette > 0) & (silhouette < 1))
    for k in range(2):
        one = gradients(*(batch[k if axis == 0 else 1] for batch, axis in zip(several, axes, strict=True)))[0]
        for a, b in zip(together, one, strict=True):
            np.testing.assert_allclose(a[k], b, rtol=1e-9, atol=1e-9 * np.abs(b).max())


# ------------------------------------------------------------------------------------------- edge cases


def test_bad_pixels_poison_nothing():
    fields, _ = reference.waves(*SIZE)
    clean = buffer(fields, np.float32)
    bad = {k: np.array(v, copy=True) for k, v in fields.items()}
    bad["normal"][10, 10] = np.nan
    bad["normal"][20, 20, 0] = np.inf
    bad["depth"][30, 30] = np.nan
    bad["position"][40, 40] = -np.inf
    g = buffer(bad, np.float32)
    far = np.ones(SIZE, bool)
    for r, c in ((10, 10), (20, 20), (30, 30), (40, 40)):
        far[r - 5 : r + 6, c - 5 : c + 6] = False
    d, wanted = se.describe(g), se.describe(clean)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(d))
    np.testing.assert_array_equal(d.hessian[far], wanted.hessian[far])
    assert not d.conductance[10, 10]
    grad = jax.grad(lambda n: jnp.sum(se.describe(replace(g, normal=n)).hessian))(g.normal)
    assert np.isfinite(np.asarray(grad)).all()


def test_empty_and_thin_images():
    for shape, on in (((1, 9), True), ((9, 1), True), ((6, 7), False)):
        fields, _ = reference.waves(*shape, mask=np.full(shape, on))
        d = se.describe(buffer(fields, np.float32), sigma=0.0)
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(d))
        assert on or not any(np.asarray(x).any() for x in jax.tree.leaves(d))


def test_wrong_arguments_are_named():
    fields, _ = reference.waves(8, 9)
    g = buffer(fields, np.float32)
    for arguments, name in (
        ({"sigma": -1.0}, "sigma"),
        ({"sigma": np.nan}, "sigma"),
        ({"sigma": np.ones(3)}, "sigma"),
        ({"foreshortening": -0.1}, "foreshortening"),
        ({"importance": np.ones((3, 3))}, "importance"),
        ({"creases": 200.0}, "creases"),
        ({"scheme": "quick"}, "scheme"),
        ({"fields": ("hessian", "curvature")}, "fields"),
    ):
        with pytest.raises(ValueError, match=name):
            se.describe(g, **arguments)
    with pytest.raises(ValueError, match=r"gbuffer\.normal"):
        se.describe(replace(g, normal=g.normal[:4]))
    with pytest.raises(ValueError, match="gbuffer"):
        se.describe(fields)


def test_colors():
    fields, _ = reference.traced_spheres(*SIZE, [((0, 0, -5), 1.0), ((0.8, 0.3, -6.5), 1.4)])
    d = se.describe(buffer(fields, np.float32))
    colors = np.asarray(se.curvature_colors(d, jnp.asarray(fields["mask"])))
    assert colors.min() >= 0
    assert colors.max() <= 1
    assert (colors[~fields["mask"]] == 1).all()
    assert (colors[np.asarray(d.silhouette) == 1] == 0).all()
    convex = (np.asarray(se.mean_curvature(d.hessian)) < -0.02) & (np.asarray(d.silhouette) == 0)
    assert (colors[convex][:, 2] > colors[convex][:, 0]).all()  # cold
    with pytest.raises(ValueError, match="scale"):
        se.curvature_colors(d, jnp.asarray(fields["mask"]), scale=0.0)
