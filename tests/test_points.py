"""Point clouds: a slow twin, laws, gradients, edge cases, estimation of what a file lacks."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import shapeenh as se
from shapeenh.buffers import pairs, splat
from shapeenh.buffers import points as module
from tests.reference import points as plain

H, W = 24, 32


def cameras(dtype=np.float64):
    """Perspective, orthographic, and perspective off centre."""
    perspective = se.perspective_camera(np.array([0.3, 0.2, 4.0], dtype), (0, 0, 0), fov_degrees=32.0, aspect=W / H)
    orthographic = se.orthographic_camera(np.array([0.5, -0.3, 4.0], dtype), (0, 0, 0), height=2.4, aspect=W / H)
    shifted = perspective.projection.at[0, 2].set(0.15).at[1, 2].set(-0.1)
    return {"perspective": perspective, "orthographic": orthographic, "shifted": se.Camera(perspective.view, shifted)}


def cloud(count, rng, radius=0.3):
    """Random discs that overlap in depth, all sides seen."""
    points = rng.uniform(-1, 1, (count, 3)) * np.array([1.2, 0.9, 0.4])
    normals = rng.normal(size=(count, 3)) + np.array([0, 0, 0.5])
    return points, normals, radius * rng.uniform(0.5, 1.5, count), rng.uniform(0, 1, (count, 3))


def splatted(points, normals, radius, camera, *, height=H, width=W, count=40, colors=None, dtype=np.float32, **options):
    """`gbuffer_from_points` of a cloud filled up to `count` discs with some that lie behind every camera used here: a
    compiled shape serves many tests."""
    points = np.atleast_2d(np.asarray(points, dtype))
    more = count - len(points)

    def fill(a, v):
        shape = np.shape(v)
        return np.concatenate([np.broadcast_to(a, (len(points), *shape)), np.broadcast_to(v, (more, *shape))]).astype(
            dtype
        )

    arrays = fill(points, [0, 0, 1e4]), fill(normals, [0, 0, 1.0]), fill(radius, 1.0)
    colors = fill(np.zeros(3) if colors is None else colors, np.zeros(3))
    return se.gbuffer_from_points(*arrays, camera, height=height, width=width, colors=colors, **options)


def fibonacci(count):
    """Nearly even points on the unit sphere."""
    k = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * k / count), np.pi * (1 + 5**0.5) * k
    return np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=-1)


# ------------------------------------------------------------------------------------------- the twin


@pytest.mark.parametrize("which", ["perspective", "orthographic", "shifted"])
@pytest.mark.parametrize("cull", ["none", "back", "front"])
def test_twin(which, cull, x64, rng):
    camera = cameras()[which]
    points, normals, radius, colors = cloud(40, rng)
    got = se.gbuffer_from_points(
        points, normals, radius, camera, height=H, width=W, colors=colors, cull=cull, tolerance=0.8
    )
    view, projection = np.asarray(camera.view), np.asarray(camera.projection)
    index, depth, normal, color = plain.splat(
        points, normals, radius, view, projection, H, W, colors=colors, tolerance=0.8, cull=cull
    )
    assert np.array_equal(np.asarray(got.mask), index >= 0)
    assert 100 < (index >= 0).sum() < H * W
    np.testing.assert_allclose(got.depth, depth, atol=1e-9)
    np.testing.assert_allclose(got.normal, normal, atol=1e-7)
    np.testing.assert_allclose(got.albedo, color, atol=1e-9)


def test_float32_agrees_with_float64(rng):
    points, normals, radius, colors = cloud(40, rng)

    def run(dtype):
        camera = cameras(dtype)["perspective"]
        arrays = [np.asarray(a, dtype) for a in (points, normals, radius)]
        return se.gbuffer_from_points(*arrays, camera, height=H, width=W, colors=colors.astype(dtype))

    with jax.enable_x64(True):
        exact = jax.tree.map(np.asarray, run(np.float64))
    got = run(np.float32)
    assert got.normal.dtype == np.float32
    assert got.depth.dtype == np.float32
    same = np.asarray(got.mask) & exact.mask
    assert (np.asarray(got.mask) != exact.mask).sum() <= 2  # a centre on a rim, in one rounding or the other
    np.testing.assert_allclose(np.asarray(got.depth)[same], exact.depth[same], atol=2e-5)
    error = np.abs(np.asarray(got.normal) - exact.normal)[same].max(axis=-1)
    assert np.quantile(error, 0.99) < 1e-3


# ------------------------------------------------------------------------------------------- laws


def test_a_plane_of_discs_is_that_plane(dtype, rng):
    """Coplanar discs of any sizes: normal, depth and position are the plane's own, whatever the weights."""
    camera = cameras(dtype)["perspective"]
    n = np.array([0.3, -0.2, 0.93])
    n /= np.linalg.norm(n)
    points = rng.uniform(-2, 2, (40, 3))
    points -= (points @ n)[:, None] * n
    got = splatted(points, n, rng.uniform(1, 2, 40), camera, dtype=dtype)
    assert bool(got.mask.all())
    n_camera = np.asarray(camera.view)[:3, :3] @ n
    tolerance = 1e-5 if dtype == np.float32 else 1e-12
    np.testing.assert_allclose(got.normal, np.broadcast_to(n_camera, (H, W, 3)), atol=10 * tolerance)
    origin = np.asarray(camera.view)[:3, 3]
    np.testing.assert_allclose((np.asarray(got.position) - origin) @ n_camera, 0, atol=10 * tolerance)
    np.testing.assert_allclose(got.depth, -got.position[..., 2], atol=tolerance)


def test_positions_project_to_their_pixels(dtype, rng):
    for camera in cameras(dtype).values():
        points, normals, radius, _ = cloud(40, rng)
        got = splatted(points, normals, radius, camera, dtype=dtype)
        p = np.asarray(got.position)[np.asarray(got.mask)]
        clip = np.concatenate([p, np.ones((len(p), 1))], axis=1) @ np.asarray(camera.projection).T
        rows, columns = np.nonzero(np.asarray(got.mask))
        np.testing.assert_allclose((clip[:, 0] / clip[:, 3] + 1) * W / 2, columns + 0.5, atol=1e-3)
        np.testing.assert_allclose((1 - clip[:, 1] / clip[:, 3]) * H / 2, rows + 0.5, atol=1e-3)


def test_a_single_disc_is_an_ellipse():
    """Its area is that of the projected circle, its depth that of its plane."""
    camera = se.orthographic_camera((0, 0, 5), (0, 0, 0), height=2.0, aspect=1.0)
    got = splatted(np.zeros(3), [0.6, 0.0, 0.8], 0.7, camera, height=128, width=128, count=6000)
    mask = np.asarray(got.mask)
    np.testing.assert_allclose(mask.sum() / 64**2, np.pi * 0.7**2 * 0.8, rtol=0.01)
    x = np.asarray(got.position)[..., 0][mask]
    np.testing.assert_allclose(np.asarray(got.depth)[mask], 5 + x * 0.6 / 0.8, atol=1e-5)
    np.testing.assert_allclose(np.abs(x).max(), 0.7 * 0.8, atol=0.02)


def test_sphere_as_points_is_the_sphere():
    """Normals within 0.1 degrees, curvature within 1 %, of the analytic sphere, off the rim."""
    camera = se.orthographic_camera((0, 0, 3), (0, 0, 0), height=2.4, aspect=1.0)
    size, scale = 128, 128 / 2.4
    points = fibonacci(6000)
    got = splatted(points, points, 0.1, camera, height=size, width=size, count=6000)
    axis = (np.arange(size) + 0.5 - size / 2) / scale
    x, y = axis[None], -axis[:, None]
    inner = x**2 + y**2 < 0.8**2
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    exact = np.stack(np.broadcast_arrays(x, y, z), axis=-1)
    assert bool(np.asarray(got.mask)[inner].all())
    angle = np.linalg.norm(np.cross(np.asarray(got.normal), exact), axis=-1)[inner]
    assert np.degrees(angle.max()) < 0.1
    assert np.abs(np.asarray(got.depth)[inner] - (3 - z)[inner]).max() < 0.005
    curvature = np.asarray(se.mean_curvature(se.describe(got).hessian)) * scale
    truth = -(1 + 1 / z[inner] ** 2) / (2 * z[inner])  # of z(x, y): -((1 + p^2) + (1 + q^2) ...)/2 with p = -x/z
    error = np.abs(curvature[inner] / truth - 1)
    assert np.median(error) < 0.005
    assert np.quantile(error, 0.99) < 0.05


def test_the_order_of_the_points_does_not_matter(x64, rng):
    camera = cameras()["perspective"]
    points, normals, radius, colors = cloud(40, rng)
    order = rng.permutation(40)
    a = se.gbuffer_from_points(points, normals, radius, camera, height=H, width=W, colors=colors)
    b = se.gbuffer_from_points(
        points[order], normals[order], radius[order], camera, height=H, width=W, colors=colors[order]
    )
    assert np.array_equal(a.mask, b.mask)
    for name in ("depth", "normal", "position", "albedo"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-10)


def test_the_sign_of_the_normals_does_not_matter_without_culling(rng):
    camera = cameras(np.float32)["perspective"]
    points, normals, radius, _ = cloud(40, rng)
    a = splatted(points, normals, radius, camera)
    b = splatted(points, -normals, radius, camera)
    np.testing.assert_allclose(a.normal, b.normal, atol=1e-6)
    front = splatted(points, normals, radius, camera, cull=True)
    back = splatted(points, -normals, radius, camera, cull="front")
    np.testing.assert_allclose(front.normal, back.normal, atol=1e-6)
    assert not np.array_equal(a.mask, front.mask)


def test_world_units_do_not_matter(rng):
    """The same scene in other units: the same picture, depth in those units."""
    points, normals, radius, _ = cloud(40, rng)
    base = None
    for unit in (1.0, 1e-6, 1e7):
        camera = se.perspective_camera((0.3 * unit, 0.2 * unit, 4 * unit), (0, 0, 0), fov_degrees=32.0, aspect=W / H)
        got = splatted(points * unit, normals, radius * unit, camera)
        if base is None:
            base = got
            continue
        assert (np.asarray(got.mask) != np.asarray(base.mask)).sum() <= 2
        same = np.asarray(got.mask) & np.asarray(base.mask)
        np.testing.assert_allclose((got.depth / unit)[same], base.depth[same], rtol=1e-4)


def test_no_point_is_lost_between_pixel_centres(rng):
    """Discs much smaller than a pixel are enlarged: each isolated point is seen."""
    camera = se.orthographic_camera((0, 0, 3), (0, 0, 0), height=float(H), aspect=W / H)
    for _ in range(20):
        point = np.array([[rng.uniform(-14, 14), rng.uniform(-10, 10), 0]])
        got = splatted(point, [0, 0, 1.0], 1e-6, camera)
        assert int(got.mask.sum()) >= 1


def test_a_second_layer_beyond_the_tolerance_does_not_show(rng):
    camera = se.orthographic_camera((0, 0, 3), (0, 0, 0), height=2.0, aspect=1.0)
    grid = np.stack([*np.meshgrid(np.linspace(-1.2, 1.2, 25), np.linspace(-1.2, 1.2, 25)), np.zeros((25, 25))], -1)
    front, tilted = grid.reshape(-1, 3), grid.reshape(-1, 3) - [0, 0, 0.5]
    n = np.tile([0, 0, 1.0], (625, 1))
    m = np.tile([0.6, 0, 0.8], (625, 1))
    red, blue = np.tile([1.0, 0, 0], (625, 1)), np.tile([0, 0, 1.0], (625, 1))
    both = [np.concatenate(p) for p in ((front, tilted), (n, m), (red, blue))]
    draw = partial(splatted, *both[:2], 0.2, camera, height=128, width=128, count=6000, colors=both[2])
    got = draw()
    np.testing.assert_allclose(got.normal, np.broadcast_to([0, 0, 1.0], (128, 128, 3)), atol=1e-6)
    np.testing.assert_allclose(got.albedo, np.broadcast_to([1.0, 0, 0], (128, 128, 3)), atol=1e-6)
    mixed = draw(tolerance=10.0)
    assert float(mixed.albedo[..., 2].min()) > 0.1


# ------------------------------------------------------------------------------------------- the list of pairs


def test_every_pair_is_visited_once(rng):
    """Small, empty and image-filling boxes, more of them than a step takes."""
    rows, columns = 50, 70
    x0, y0 = rng.integers(0, 4 * columns, 6000), rng.integers(0, 4 * rows, 6000)
    x1 = np.minimum(x0 + rng.integers(-3, 9, 6000), 4 * columns - 1)
    y1 = np.minimum(y0 + rng.integers(-3, 9, 6000), 4 * rows - 1)
    for k in (0, 17, 3000, 5999):
        x0[k], x1[k], y0[k], y1[k] = 0, 4 * columns - 1, 0, 4 * rows - 1
    boxes = pairs.tile_boxes(*(jnp.asarray(a, jnp.int32) for a in (x0, x1, y0, y1)))

    def count(state, disc, column, row, valid):
        tiles, discs = state
        tiles = tiles.at[row * columns + column].add(valid.astype(jnp.int32))
        return tiles, discs.at[disc].add(valid.astype(jnp.int32))

    zero = jnp.zeros(rows * columns, jnp.int32), jnp.zeros(6000, jnp.int32)
    tiles, discs = jax.jit(lambda b: pairs.walk(b, count, zero))(boxes)
    expected = np.zeros((rows, columns), int)
    for a, b, c, d in zip(x0, x1, y0, y1, strict=True):
        if b >= a and d >= c:
            expected[c // 4 : d // 4 + 1, a // 4 : b // 4 + 1] += 1
    assert np.array_equal(np.asarray(tiles).reshape(rows, columns), expected)
    assert np.array_equal(discs, np.asarray(boxes[:, 2] * boxes[:, 3]))


def test_tiles_and_images(rng):
    image = jnp.asarray(rng.normal(size=(7, 10, 3)), jnp.float32)
    assert np.array_equal(pairs.from_tiles(pairs.to_tiles(image), 7, 10), image)


def test_sortable_keys(rng):
    values = np.sort(np.concatenate([rng.normal(size=50) * 10.0 ** rng.integers(-20, 20, 50), [0.0]])).astype(
        np.float32
    )
    with jax.enable_x64(True):
        keys = np.asarray(splat.pack(jnp.ones(51, bool), jnp.asarray(values), jnp.zeros(51, jnp.uint32)))
        assert np.all(np.diff(keys.astype(object)) > 0)
        assert np.all(keys > 0)


# ------------------------------------------------------------------------------------------- gradients


def loss(arguments, weights):
    """A random linear function of the picture, and the picture; arguments: points, normals, radius, colors, tolerance,
    view, projection."""
    *arrays, colors, tolerance, view, projection = arguments
    camera = se.Camera(view, projection)
    got = se.gbuffer_from_points(*arrays, camera, height=12, width=16, colors=colors, tolerance=tolerance)
    fields = (got.depth[..., None], got.normal, got.position, got.albedo)
    return sum(jnp.sum(w * f) for w, f in zip(weights, fields, strict=True)), got


GRADIENT = jax.jit(jax.grad(loss, has_aux=True))


@pytest.mark.thorough
def test_the_sums_have_the_gradient_that_autodiff_gives(x64, rng):
    """The hand-written walk back against autodiff of the same sums over a dense table of pairs."""
    camera = cameras()["perspective"]
    points, normals, radius, colors = (jnp.asarray(a) for a in cloud(20, rng))
    window = module.window_rows(camera.projection, 12, 16)
    discs, seen = module.project_discs(
        points, normals, radius, colors, camera.view, camera.projection, window, jnp.asarray(1.0), 0
    )
    boxes = module.pixel_boxes(discs, seen, 12, 16)
    near = module.near_depth(camera.projection)
    index = splat.visible_discs(discs, boxes, near, 12, 16)
    front = pairs.to_tiles(module.front_surface(discs, jnp.maximum(index, 0)) * (index >= 0)[..., None])
    weights = jnp.asarray(rng.normal(size=(12, 20, pairs.LANES)))
    tile = jnp.arange(12, dtype=jnp.int32)
    column, row = tile % 4, tile // 4

    def dense(discs, front):
        def one(disc, seen):
            d = jnp.broadcast_to(disc, (12, disc.shape[0]))
            inputs = splat.arguments(d, front, near, column, row, jnp.broadcast_to(seen, (12,)))
            w, w_depth = splat.weights(*inputs)
            c = splat.constants(d, column, row)
            return jnp.concatenate([w[:, None] * c[:, :, None], w_depth[:, None]], axis=1)

        return jnp.sum(jnp.sum(jax.vmap(one)(discs, seen), axis=0) * weights)

    def walked(discs, front):
        return jnp.sum(splat.disc_sums(discs, front, near, boxes, (12, 16)) * weights)

    (a, a_grads), (b, b_grads) = (jax.jit(jax.value_and_grad(f, argnums=(0, 1)))(discs, front) for f in (walked, dense))
    np.testing.assert_allclose(a, b, rtol=1e-11)
    for got, exact in zip(a_grads, b_grads, strict=True):
        np.testing.assert_allclose(got, exact, rtol=1e-8, atol=1e-9 * float(jnp.abs(exact).max()))


# ------------------------------------------------------------------------------------------- JAX


def test_other_values_do_not_recompile(rng, compilations):
    points, normals, radius, colors = (np.asarray(a, np.float32) for a in cloud(40, rng))
    views = list(cameras(np.float32).values())
    tilted = [se.Camera(v.view, v.projection) for v in views]
    draw = partial(se.gbuffer_from_points, height=H, width=W, colors=colors)
    draw(points, normals, radius, views[0])
    compilations.clear()
    for k, cull in enumerate((False, True, "front")):
        draw(points + np.float32(0.1 * k), normals, radius * (1 + k), tilted[k], cull=cull, tolerance=0.5 + k)
    assert compilations == []


def test_jit_and_vmap(rng):
    arrays = [np.asarray(a, np.float32) for a in cloud(40, rng)]
    views = [se.perspective_camera((x, 0.2, 4.0), (0, 0, 0), fov_degrees=32.0, aspect=W / H) for x in (0.1, 0.5)]
    one = lambda camera: se.gbuffer_from_points(*arrays[:3], camera, height=H, width=W, colors=arrays[3])  # noqa: E731
    together = jax.jit(jax.vmap(one))(jax.tree.map(lambda *a: jnp.stack(a), *views))
    for k, view in enumerate(views):
        apart = one(view)
        assert np.array_equal(together.mask[k], apart.mask)
        np.testing.assert_allclose(together.depth[k], apart.depth, atol=1e-5)
        np.testing.assert_allclose(together.normal[k], apart.normal, atol=5e-5)


@pytest.mark.thorough
def test_gradients_under_vmap(x64, rng):
    arrays = [jnp.asarray(a) for a in cloud(25, rng, radius=0.5)]
    views = [se.perspective_camera((x, 0.2, 4.0), (0, 0, 0), fov_degrees=32.0, aspect=W / H) for x in (0.1, 0.5)]
    weights = [jnp.asarray(rng.normal(size=(12, 16, k))) for k in (1, 3, 3, 3)]
    of = lambda camera: GRADIENT([*arrays, jnp.asarray(0.9), camera.view, camera.projection], weights)[0]  # noqa: E731
    together = jax.vmap(of)(jax.tree.map(lambda *a: jnp.stack(a), *views))
    for k, view in enumerate(views):
        for got, exact in zip(together, of(view), strict=True):
            np.testing.assert_allclose(got[k], exact, rtol=1e-9, atol=1e-9 * float(jnp.abs(exact).max()))


# ------------------------------------------------------------------------------------------- edge cases


def test_an_empty_cloud_and_small_images():
    camera = cameras(np.float32)["perspective"]
    for height, width in ((1, 1), (1, 9), (9, 1), (5, 7)):
        none = se.gbuffer_from_points(
            np.zeros((0, 3)), np.zeros((0, 3)), 1.0, camera, height=height, width=width, colors=np.zeros((0, 3))
        )
        assert none.mask.shape == (height, width)
        assert not bool(none.mask.any())
        assert none.albedo.shape == (height, width, 3)
    one = se.gbuffer_from_points([[0.0, 0, 0]], [[0.0, 0, 1]], 100.0, camera, height=1, width=9)
    assert bool(one.mask.all())
    assert bool(jnp.isfinite(one.normal).all())
    empty = se.gbuffer_from_points(np.zeros((0, 3)), None, None, camera, height=3, width=4)
    assert not bool(empty.mask.any())


def test_discs_at_and_behind_the_eye(x64):
    """The eye plane through a disc: the part in front is drawn, as in the twin. Behind: nothing."""
    camera = se.perspective_camera((0, 0, 0), (0, 0, -1), fov_degrees=60.0, aspect=W / H, near=0.1)
    floor = np.array([[0.0, -1.0, 1e-9]])
    got = splatted(floor, [0, 1.0, 0], 50.0, camera, dtype=np.float64)
    index, depth, _, _ = plain.splat(
        floor, np.array([[0, 1.0, 0]]), np.array([50.0]), np.asarray(camera.view), np.asarray(camera.projection), H, W
    )
    assert np.array_equal(np.asarray(got.mask), index >= 0)
    assert int(got.mask.sum()) > W * H // 3
    np.testing.assert_allclose(got.depth, depth, rtol=1e-9)
    for z in (3.0, -0.05):  # behind the eye, and before the near plane
        assert not bool(splatted([0, 0, z], [0, 0, 1.0], 1.0, camera, dtype=np.float64).mask.any())


def awkward(seed, size):
    """Discs from far below a pixel to far beyond the image, some of them behind the eye or far away."""
    rng = np.random.default_rng(seed)
    points, normals, radius, colors = cloud(25, rng, radius=size)
    points[: seed % 7] *= 30
    return points, normals, radius, colors


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(0, 2**31 - 1), st.sampled_from([1e-4, 0.05, 1.0, 300.0]), st.booleans())
def test_every_seen_pixel_has_a_surface(seed, size, parallel):
    """Whatever the discs: on the mask a depth and a unit normal towards the viewer, off it zeros."""
    points, normals, radius, _ = awkward(seed, size)
    got = splatted(points, normals, radius, cameras(np.float32)["orthographic" if parallel else "perspective"])
    mask = np.asarray(got.mask)
    assert np.all(np.asarray(got.depth)[mask] > 0)
    assert np.all(np.isfinite(np.asarray(got.position)))
    length = np.linalg.norm(np.asarray(got.normal), axis=-1)
    np.testing.assert_allclose(length[mask], 1, atol=1e-5)
    assert np.all(np.asarray(got.normal)[mask][:, 2] > 0.009)
    assert np.all(length[~mask] == 0)


@pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=pytest.mark.thorough)])
def test_gradients_are_finite(dtype):
    with jax.enable_x64(dtype == "float64"):
        for seed in range(8):
            for size in (1e-4, 0.05, 1.0, 300.0):
                camera = cameras(dtype)["perspective" if seed % 2 else "orthographic"]
                arrays = [jnp.asarray(a, dtype) for a in awkward(seed, size)]
                weights = [jnp.full((12, 16, k), 0.1 * k, dtype) for k in (1, 3, 3, 3)]
                arguments = [*arrays, jnp.asarray(0.9, dtype), camera.view, camera.projection]
                assert all(bool(jnp.isfinite(g).all()) for g in GRADIENT(arguments, weights)[0])


def test_a_ray_within_the_plane_of_a_disc_meets_nothing():
    """Its determinant is rounding, and may be so small that its square is 0: 0 <= 0 is no hit."""
    disc = np.zeros((1, splat.GEOMETRY), np.float32)
    disc[0, [0, 4]] = 1e-25, 1e-5  # X = 1e-25 a, Y = 1e-5 b, W = 1: qa = 1e-28, q = 1e-30
    disc[0, [2, 8]] = 1e-23, 1
    zero = jnp.zeros((1, 1), jnp.float32)
    a, b, hit = splat.meet(jnp.asarray(disc), zero, zero)
    assert not hit.any()
    assert np.all(a == 0)
    assert np.all(b == 0)


def test_where_no_disc_weighs_anything_the_front_one_stands_alone(monkeypatch):
    monkeypatch.setattr(splat, "SLACK", -0.99)  # as if other rounding missed all but the middle of what was hit before
    point, normal, color = np.array([0.1, 0.05, 0.2]), np.array([0.2, -0.1, 1.0]), np.array([0.2, 0.5, 0.8])
    camera = cameras(np.float32)["perspective"]
    gbuffer = splatted(point, normal, 0.6, camera, width=W + 1, colors=color)  # a shape that is not compiled yet
    mask, view = np.asarray(gbuffer.mask), np.asarray(camera.view, np.float64)
    assert mask.sum() > 50
    n = view[:3, :3] @ normal / np.linalg.norm(normal)
    away = (np.asarray(gbuffer.position)[mask] - view[:3, :3] @ point - view[:3, 3]) @ n
    np.testing.assert_allclose(away, 0, atol=1e-5)
    np.testing.assert_allclose(gbuffer.depth[mask], -gbuffer.position[mask][:, 2], rtol=1e-6)
    np.testing.assert_allclose(gbuffer.normal[mask], np.broadcast_to(n, (mask.sum(), 3)), atol=1e-5)
    np.testing.assert_allclose(gbuffer.albedo[mask], np.broadcast_to(color, (mask.sum(), 3)), atol=1e-5)


def test_errors(rng):
    camera = cameras(np.float32)["perspective"]
    points, normals, radius, colors = cloud(10, rng)
    zero, nan = normals.copy(), points.copy()
    zero[3] = 0
    nan[2, 1] = np.nan
    cases = [
        ((nan, normals, radius), {}, "points holds 1 NaN"),
        ((points[:, :2], normals, radius), {}, r"points has shape \(10, 2\)"),
        ((points, normals[:9], radius), {}, r"normals has shape \(9, 3\)"),
        ((points, zero, radius), {}, "normals holds 1 zero"),
        ((points, normals, radius[:4]), {}, r"radius has shape \(4,\)"),
        ((points, normals, -1.0), {}, "radius is -1"),
        ((points, normals, radius), {"colors": colors[:2]}, "colors has shape"),
        ((points, normals, radius), {"cull": "left"}, "cull is 'left'"),
        ((points, normals, radius), {"tolerance": 0}, "tolerance is 0"),
        ((points, normals, radius), {"height": 0}, "height is 0"),
        ((points[:2], None, radius[:2]), {}, "at least 3 points"),
    ]
    for arrays, options, message in cases:
        with pytest.raises(ValueError, match=message):
            se.gbuffer_from_points(*arrays, camera, **{"height": H, "width": W, **options})
    with pytest.raises(ValueError, match="camera is a NoneType"):
        se.gbuffer_from_points(points, normals, radius, None, height=H, width=W)
    with pytest.raises(ValueError, match="traced"):
        jax.jit(lambda p: se.gbuffer_from_points(p, None, 0.1, camera, height=H, width=W))(points)


# ------------------------------------------------------------------------------------------- estimation


def test_estimated_normals_and_radii_of_a_sphere():
    points = 2.0 * fibonacci(6000) + np.array([1.0, 2.0, 3.0])
    outwards = (points - [1, 2, 3]) / 2
    normals = se.estimate_normals(points)
    assert np.degrees(np.arccos(np.sum(normals * outwards, axis=1).clip(-1, 1))).max() < 2
    camera = se.perspective_camera((1, 2, 20.0), (1, 2, 3), fov_degrees=30.0, aspect=1.0)
    towards = se.estimate_normals(points, camera=camera)
    assert np.all(np.sum(towards * ([1, 2, 20.0] - points), axis=1) >= 0)
    parallel = se.orthographic_camera((1, 2, 20.0), (1, 2, 3), height=5.0, aspect=1.0)
    assert np.all(se.estimate_normals(points, camera=parallel)[:, 2] >= 0)
    radius = se.estimate_radius(points, coverage=8.0)
    covered = 6000 * np.pi * radius.mean() ** 2 / (4 * np.pi * 4)
    assert 6 < covered < 10
    black = np.zeros((6000, 3))
    got = se.gbuffer_from_points(points, None, None, camera, height=128, width=128, colors=black)
    given_ = se.gbuffer_from_points(points, outwards, radius, camera, height=128, width=128, colors=black)
    inner = np.asarray(given_.normal[..., 2]) > 0.4
    angle = np.linalg.norm(np.cross(np.asarray(got.normal), np.asarray(given_.normal)), axis=-1)
    assert np.degrees(angle[inner]).max() < 2


def test_estimation_of_odd_clouds(rng):
    line = np.stack([np.linspace(0, 1, 20), np.zeros(20), np.zeros(20)], axis=1)
    for points in (np.zeros((5, 3)), line, rng.normal(size=(3, 3)), np.repeat(rng.normal(size=(4, 3)), 30, axis=0)):
        normals, radius = se.estimate_normals(points), se.estimate_radius(points)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
        assert np.all(radius > 0)
        assert np.all(np.isfinite(radius))
    with pytest.raises(ValueError, match="neighbors is 2"):
        se.estimate_normals(line, neighbors=2)
    with pytest.raises(ValueError, match="coverage is 0"):
        se.estimate_radius(line, coverage=0)
