"""Line fields of all kinds: what they are on known surfaces, smoothing, singularities, gradients, edge cases."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import KDTree

import shapeenh as se
from shapeenh.lines import smoothing
from shapeenh.lines.tiles import list_tiles
from shapeenh.types import GBuffer, replace
from tests.reference import lines as reference

SIZE = 48
ROW, COL = np.mgrid[0:SIZE, 0:SIZE].astype(float)
X, Y = COL - SIZE / 2 + 0.5, SIZE / 2 - 0.5 - ROW


def fold(angle, sign):
    """The G-buffer of a rounded roof (sign +1: a ridge towards the viewer) or gutter (-1) along a direction."""
    across = -np.sin(angle) * X + np.cos(angle) * Y
    slope = -sign * 0.8 * np.tanh(across / 3)
    normal = np.stack([np.sin(angle) * slope, -np.cos(angle) * slope, np.ones_like(X)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    depth = 100 + sign * 0.8 * 3 * np.log(np.cosh(across / 3))
    position = np.stack([X, Y, -depth], -1)
    arrays = [jnp.asarray(a, jnp.float32) for a in (depth, normal, position)]
    return GBuffer(jnp.ones((SIZE, SIZE), bool), *arrays), across


def disc_before_wall(gap=30.0, radius=14.0, wall=True):
    """A flat disc in front of a flat wall (or of nothing)."""
    inside = np.hypot(X, Y) < radius
    depth = np.where(inside, 100.0, 100.0 + gap)
    mask = np.ones_like(inside) if wall else inside
    position = np.where(mask[..., None], np.stack([X, Y, -depth], -1), 0)
    normal = np.where(mask[..., None], [0.0, 0.0, 1.0], 0)
    arrays = [jnp.asarray(a, jnp.float32) for a in (np.where(mask, depth, 0), normal, position)]
    return GBuffer(jnp.asarray(mask), *arrays)


# ------------------------------------------------------------------------------------------- what the kinds find


@pytest.mark.parametrize("angle", [0.6, np.pi / 2])
@pytest.mark.parametrize(("kind", "other", "sign"), [("ridge", "valley", 1), ("valley", "ridge", -1)])
def test_ridges_are_convex_and_valleys_concave(angle, kind, other, sign):
    gbuffer, across = fold(angle, sign)
    descriptor = se.describe(gbuffer)
    found = se.fit_profile(se.line_field(kind, gbuffer, descriptor))
    middle = X**2 + Y**2 < 15**2
    near = middle & (np.abs(across) <= 2)
    assert np.all(np.asarray(found.valid)[near])
    field = se.line_field(kind, gbuffer, descriptor)
    theta = np.asarray(field.direction)
    # the direction is that of the curvature, across the fold; the skeleton is the fold
    cosine = np.abs(-np.sin(angle) * theta[..., 0] + np.cos(angle) * theta[..., 1])
    assert np.min(cosine[near]) > 0.999
    arrow = np.sign(-np.sin(angle) * theta[..., 0] + np.cos(angle) * theta[..., 1])
    assert np.max(np.abs(across + arrow * np.asarray(found.distance))[near]) < 0.35
    hm = np.asarray(se.mean_curvature(descriptor.hessian))
    assert np.all(sign * hm[near] < 0)
    none = se.fit_profile(se.line_field(other, gbuffer, descriptor), least=1e-3)
    assert not np.any(np.asarray(none.valid)[middle & (np.abs(across) < 4)])


def test_heights_are_those_of_the_table():
    gbuffer, _ = fold(0.6, 1)
    d = se.describe(gbuffer)
    k1, k2 = se.principal_curvatures(d.hessian)
    height = {k: se.line_field(k, gbuffer, d, sigma=0.0).height for k in ("ridge", "valley", "surface")}
    hm = np.asarray(se.mean_curvature(d.hessian))
    assert np.mean(hm < 0) > 0.5
    np.testing.assert_allclose(np.where(hm <= 0, height["ridge"] + k2, 0), 0, atol=1e-6)
    np.testing.assert_allclose(np.where(hm >= 0, height["valley"] - k1, 0), 0, atol=1e-6)
    np.testing.assert_allclose(height["surface"], np.hypot(d.gradient[..., 0], d.gradient[..., 1]), atol=1e-6)
    expected = np.hypot(*np.gradient(hm))[4:-4, 4:-4]
    inflection = np.asarray(se.line_field("inflection", gbuffer, d, sigma=0.0).height)[4:-4, 4:-4]
    # ours averages 1:4:1 across, numpy does not: second order apart
    np.testing.assert_allclose(inflection, expected, atol=0.05 * expected.max())


def test_the_stronger_curvature_of_a_saddle_is_a_line_and_the_weaker_is_none():
    """(concave, convex): heights fall from equality on, and are 0 where the other is 1.5 times as strong."""
    for a, b, ridge, valley in (
        (0.3, 0.1, 0.0, 0.3),
        (0.3, 0.3, 0.3, 0.3),
        (0.24, 0.3, 0.3, 0.12),
        (0.2, 0.3, 0.3, 0.0),
    ):
        hessian = np.broadcast_to(np.float32([a, 0, -b]), (9, 9, 3))
        d = se.Descriptor(jnp.asarray(hessian), jnp.zeros((9, 9, 2)), *(jnp.zeros((9, 9)) for _ in range(3)))
        gbuffer = GBuffer(jnp.ones((9, 9), bool), *(jnp.ones((9, 9, *s)) for s in ((), (3,), (3,))))
        for kind, expected in (("ridge", ridge), ("valley", valley)):
            np.testing.assert_allclose(se.line_field(kind, gbuffer, d, sigma=0.0).height, expected, atol=1e-6)


def test_inflections_run_where_the_curvature_changes_sign():
    across = Y
    slope = np.cos(2 * np.pi * across / 32)  # curvature -sin: extremal variation at its zeros
    normal = np.stack([np.zeros_like(X), -slope, np.ones_like(X)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    gbuffer = se.gbuffer_from_normals(jnp.asarray(normal, jnp.float32), check=False)
    found = se.fit_profile(se.line_field("inflection", gbuffer, se.describe(gbuffer)))
    for line in (-16.0, 0.0, 16.0):
        near = (np.abs(across - line) < 1.5) & (np.abs(X) < 16) & (np.abs(across) < 18)
        assert np.all(np.asarray(found.valid)[near])
        assert np.max(np.abs(np.abs(across - line) - np.abs(found.distance))[near]) < 0.3


@pytest.mark.parametrize("wall", [True, False])
def test_occlusion_lines_coincide_with_depth_steps(wall):
    gbuffer = disc_before_wall(wall=wall)
    field = se.line_field("occlusion", gbuffer, se.describe(gbuffer))
    found = se.fit_profile(field, radius=3.0, least=0.05)
    r = np.hypot(X, Y)
    valid = np.asarray(found.valid)
    assert np.all(valid[np.abs(r - 14) <= 1])
    skeleton = valid & (np.abs(found.distance) <= 0.5)
    assert np.max(np.abs(r[skeleton] - 14)) <= 1
    # every pixel next to the step has a skeleton within a pixel of it
    theta, d = np.asarray(field.direction), np.asarray(found.distance)
    target = np.hypot(X + d * theta[..., 0], Y + d * theta[..., 1])
    assert np.max(np.abs(target - 14)[valid & (np.abs(r - 14) <= 1)]) <= 1
    assert not np.any(valid[np.abs(r - 14) > 5])


def test_a_step_no_deeper_than_the_slope_in_front_of_it_has_its_line():
    """As on limbs, whose near side turns away: the step between pixels there is less than that along the slope."""
    slope, step = np.where(X < 0, 5.0, 0.0), 4.0
    depth = np.where(X < 0, 100 + 5 * (X + 0.5), 100 + step)
    normal = np.stack([slope, np.zeros_like(X), np.ones_like(X)], -1) / np.hypot(slope, 1)[..., None]
    arrays = [jnp.asarray(a, jnp.float32) for a in (depth, normal, np.stack([X, Y, -depth], -1))]
    gbuffer = GBuffer(jnp.ones((SIZE, SIZE), bool), *arrays)
    field = se.line_field("occlusion", gbuffer, se.describe(gbuffer))
    found = se.fit_profile(field, radius=se.fit_radius("occlusion"), least=0.05)
    near = (np.abs(X) < 1) & (np.abs(Y) < 20)
    assert np.all(np.asarray(found.valid)[near])
    np.testing.assert_allclose((X + np.asarray(found.distance) * field.direction[..., 0])[near], 0, atol=0.2)


def test_steep_smooth_slopes_are_no_occlusions():
    gbuffer, _ = fold(0.6, 1)
    field = se.line_field("occlusion", gbuffer, se.describe(gbuffer))
    assert np.max(np.asarray(field.height)[6:-6, 6:-6]) < 1e-3


def test_luminance_edges_without_geometry():
    image = 0.5 + 0.4 * np.tanh((0.8 * X + 0.6 * Y - 3) / 3)
    field = se.line_field("luminance", None, None, luminance=jnp.asarray(image, jnp.float32))
    found = se.fit_profile(field, least=0.01)
    across = 0.8 * X + 0.6 * Y - 3
    near = (np.abs(across) < 2) & (np.abs(X) < 15) & (np.abs(Y) < 15)
    assert np.all(np.asarray(found.valid)[near])
    assert np.max(np.abs(np.abs(across) - np.abs(found.distance))[near]) < 0.35


def test_planes_have_no_lines_of_any_kind():
    tilted = np.broadcast_to(np.float32([0.3, -0.2, 0.933]), (SIZE, SIZE, 3))
    depth = np.float32(100 + (0.3 * X - 0.2 * Y) / 0.933)
    gbuffer = se.gbuffer_from_normals(jnp.asarray(tilted), depth=jnp.asarray(depth), check=False)
    d = se.describe(gbuffer, sigma=1.0)
    for kind in ("ridge", "valley", "inflection", "surface"):
        assert not np.any(se.fit_profile(se.line_field(kind, gbuffer, d)).valid), kind


# ------------------------------------------------------------------------------------------- a mesh


@pytest.fixture(scope="module")
def knot():
    """The embedded object: it has grooves, bumps, limbs and parts that hide others: (G-buffer, descriptor, camera)."""
    mesh = se.carved_knot()
    camera = se.frame_mesh(mesh, direction=(0.34, 0.26, 0.9), aspect=1.0)
    gbuffer = se.render_gbuffer(mesh, camera, height=360, width=360)
    return gbuffer, se.describe(gbuffer, sigma=1.2), camera


def skeleton(profile):
    return np.asarray(profile.valid) & (np.abs(profile.distance) <= 0.5)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "sign"), [("ridge", -1), ("valley", 1)])
def test_strong_lines_of_a_mesh_lie_on_their_side_of_flat(kind, sign, knot):
    gbuffer, descriptor, _ = knot
    strong = float(se.style_brush("ink", kind, height=360).high)
    found = se.fit_profile(se.line_field(kind, gbuffer, descriptor), least=strong)
    on = skeleton(found)
    assert on.sum() > 300
    assert np.mean(sign * np.asarray(se.mean_curvature(descriptor.hessian))[on] > 0) >= 0.95


@pytest.mark.slow
def test_occlusion_lines_of_a_mesh_lie_within_a_pixel_of_its_depth_steps(knot):
    gbuffer, descriptor, camera = knot
    field = se.line_field("occlusion", gbuffer, descriptor)
    least = float(se.style_brush("ink", "occlusion").low)
    points = reference.line_points(se.fit_profile(field, radius=se.fit_radius("occlusion"), least=least), field)
    assert len(points) > 1000
    off = reference.distance_to_borders(points, reference.step_borders(gbuffer, camera, 1.0))
    assert np.mean(off <= 1) > 0.9995  # the others run between two steps 3 px apart, so
    assert np.max(off) <= 1.5
    assert np.mean(off <= 0.5) > 0.96
    missed = KDTree(points).query(reference.step_borders(gbuffer, camera, 5.0).mean(axis=1))[0]
    assert np.mean(missed <= 1) > 0.97


def noisy_ripples(n=161, noise=0.004):
    """A sheet with waves around its centre, and noise on its right half."""
    y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j]
    r = np.hypot(x, y)
    z = 0.05 * np.cos(22 * r) / (1 + 0.5 * r)
    z += np.where(x > 0, noise, 0) * np.random.default_rng(5).normal(size=z.shape)
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, d), (a, d, c))])
    return se.make_mesh(np.float32(np.stack([x, y, z], -1).reshape(-1, 3)), np.int32(faces))


@pytest.mark.slow
def test_lines_of_a_noisy_mesh_agglomerate_with_distance():
    """TH10 fig. 7.4: from afar the noise is gone, lines become fewer, none of them is a speckle."""
    mesh, size = noisy_ripples(), 240
    counts, speckles, ink = [], [], []
    for distance in (1, 2, 4):
        camera = se.orthographic_camera((0, -1.2, 2.0), (0, 0, 0), height=1.9 * distance, aspect=1.0)
        gbuffer = se.render_gbuffer(mesh, camera, height=size, width=size)
        descriptor = se.describe(gbuffer, sigma=1.5)
        brush = replace(se.style_brush("ink", "valley", height=600), shortest=0.0)  # no sieve: what is there is drawn
        field = se.line_field("valley", gbuffer, descriptor)
        profile = se.fit_profile(field, least=float(brush.low))
        drawn = np.asarray(se.draw_lines(profile, field, brush, gbuffer=gbuffer, descriptor=descriptor))[..., 3] > 0.5
        labels, count = ndimage.label(drawn, np.ones((3, 3)))
        area = np.bincount(labels.ravel())[1:]
        counts.append(count)
        speckles.append(area[area < 12].sum() / area.sum())
        halves = np.asarray(gbuffer.mask).nonzero()[1]
        middle = (halves.min() + halves.max() + 1) // 2
        ink.append(drawn[:, middle:].sum() / drawn[:, :middle].sum())
    assert counts[0] > 3 * counts[1]
    assert counts[1] >= counts[2]
    assert 8 <= counts[2] <= 20  # about as many as there are rings and cut corners
    assert max(speckles[1:]) < 0.04
    assert abs(ink[1] - 1) < 0.15  # the noisy half is drawn like the clean one
    assert abs(ink[2] - 1) < 0.15


# ------------------------------------------------------------------------------------------- singularities, smoothing


def test_direction_singularity_equals_the_twin(rng):
    angle = np.cumsum(rng.normal(size=(14, 15)) * 0.4, axis=0)
    theta = np.stack([np.cos(angle), np.sin(angle)], -1)
    mask = rng.random((14, 15)) < 0.8
    field = se.make_line_field(np.ones((14, 15), np.float32), np.float32(theta), mask=mask)
    expected = reference.direction_singularity(theta, mask)
    np.testing.assert_allclose(field.singularity, expected, atol=1e-5)
    assert np.all(np.asarray(field.singularity)[~mask] == 1)


def test_silhouettes_are_singular_and_insulate():
    silhouette = np.zeros((SIZE, SIZE), np.float32)
    silhouette[:, 24] = 1
    height = np.where(COL < 24, 1.0, 5.0).astype(np.float32)
    theta = np.broadcast_to(np.float32([1, 0]), (SIZE, SIZE, 2))
    field = se.make_line_field(height, theta, silhouette=silhouette, sigma=3.0)
    np.testing.assert_array_equal(np.asarray(field.singularity)[:, 24], 1)
    np.testing.assert_allclose(np.asarray(field.height)[:, :24], 1.0, atol=1e-5)
    np.testing.assert_allclose(np.asarray(field.height)[:, 25:], 5.0, atol=1e-5)


def test_directions_are_smoothed_as_lines(rng):
    """theta and -theta are the same: flipped pixel by pixel they neither cancel nor change the result."""
    flip = np.where(rng.random((SIZE, SIZE)) < 0.5, -1, 1).astype(np.float32)[..., None]
    angle = 0.5 + 0.3 * rng.normal(size=(SIZE, SIZE))
    theta = np.float32(np.stack([np.cos(angle), np.sin(angle)], -1))
    height = np.float32(1 + 0.2 * np.sin(X / 4))
    a = se.make_line_field(height, theta, sigma=2.0)
    b = se.make_line_field(height, theta * flip, sigma=2.0)
    np.testing.assert_allclose(a.height, b.height, atol=1e-6)
    np.testing.assert_allclose(np.abs(np.sum(np.asarray(a.direction) * b.direction, -1)), 1, atol=1e-5)
    middle = np.asarray(a.direction)[8:-8, 8:-8]
    assert np.max(np.abs(np.arctan2(middle[..., 1], middle[..., 0]) - 0.5)) < 0.3
    np.testing.assert_allclose(np.linalg.norm(a.direction, axis=-1), 1, atol=1e-5)


# ------------------------------------------------------------------------------------------- only where something is


@pytest.mark.parametrize(("corner", "centre"), [((70, 93), (44, 40)), ((0, 0), (15, 12)), ((152, 240), (70, 75))])
@pytest.mark.parametrize("kind", ["valley", pytest.param("occlusion", marks=pytest.mark.slow)])
def test_a_small_object_in_a_large_frame_has_the_lines_of_the_frame_cut_to_it(kind, corner, centre):
    """Tiles give what the cut frame gives as a whole, also where the image ends in the middle of the object."""
    n, shape = 88, (240, 328)
    row, col = np.mgrid[0:n, 0:n].astype(float) - np.reshape(centre, (2, 1, 1))
    radius = np.hypot(row, col)
    z = np.where(radius < 24, 4 * np.cos(radius / 3) + np.sin(col / 3) + 9 * (col > row), np.nan)
    small = se.gbuffer_from_height(jnp.asarray(z, jnp.float32))
    place = [(c, size - n - c) for c, size in zip(corner, shape, strict=True)]
    small = small, se.describe(small)
    large = jax.tree.map(lambda a: jnp.pad(a, [*place, *[(0, 0)] * (a.ndim - 2)]), small)
    assert list_tiles(large[0].mask, 8) is not None
    assert list_tiles(small[0].mask, 8) is None
    cut, found = np.s_[corner[0] : corner[0] + n, corner[1] : corner[1] + n], []
    for gbuffer, descriptor in (small, large):
        field = se.line_field(kind, gbuffer, descriptor)
        profile = se.fit_profile(field, radius=3.0, least=0.02)
        sheets = {} if kind == "occlusion" else {"gbuffer": gbuffer, "descriptor": descriptor}
        strokes = se.draw_lines(profile, field, se.Brush(low=0.02, high=0.1), **sheets)
        found.append(jax.tree.leaves((field, profile, strokes)))
    assert np.any(np.asarray(strokes)[..., 3] > 0.5)
    for k, (ours, whole) in enumerate(zip(found[1], found[0], strict=True)):
        near = 1e-6 if k < 3 else 1e-3  # places of samples are rounded, more so far from the first pixel
        np.testing.assert_allclose(np.asarray(ours, float)[cut], np.asarray(whole, float), atol=near)
        around = np.ones(shape, bool)
        around[cut] = False
        assert len(np.unique(np.asarray(ours)[around])) == 1


def test_lines_of_a_small_object_in_a_large_frame_in_float64(x64):
    row, col = np.mgrid[0:240, 0:328].astype(float) - np.reshape([70, 93], (2, 1, 1))
    radius = np.hypot(row, col)
    z = np.where(radius < 24, 4 * np.cos(radius / 3), np.nan)
    found = []
    for dtype in (np.float64, np.float32):
        gbuffer = se.gbuffer_from_height(jnp.asarray(z, dtype))
        assert list_tiles(gbuffer.mask, 8) is not None
        field = se.line_field("valley", gbuffer, se.describe(gbuffer))
        profile = se.fit_profile(field, radius=3.0, least=0.02)
        found.append((field.height, profile.height, se.draw_lines(profile, field, se.Brush(low=0.02, high=0.1))))
    assert all(a.dtype == np.float64 and b.dtype == np.float32 for a, b in zip(*found, strict=True))
    np.testing.assert_allclose(found[1][0], found[0][0], atol=1e-5)
    assert np.any(np.asarray(found[0][2])[..., 3] > 0.5)


@pytest.mark.parametrize(
    ("kind", "sigma"),
    [("luminance", 1.0), ("own", 6.0), *(pytest.param("valley", s, marks=pytest.mark.slow) for s in (1.0, 6.0))],
)
def test_a_small_relief_on_a_wide_plane_is_found_without_a_mask(kind, sigma, monkeypatch):
    """What is flat is left out, also where no mask says so, and without a trace."""
    row, col = np.mgrid[0:400, 0:520].astype(float)
    bump = 3 * np.clip(1 - np.hypot(row - 170, col - 260) / 20, 0, 1) ** 2
    bump[230, 300] = np.nan if kind == "luminance" else 0

    def field():
        if kind == "luminance":
            return se.line_field("luminance", None, None, luminance=np.float32(bump), sigma=sigma)
        if kind == "own":
            theta = np.where(bump[..., None] > 0, [0.6, 0.8], 0.0)
            return se.make_line_field(np.float32(bump), np.float32(theta), sigma=sigma)
        gbuffer = se.gbuffer_from_height(jnp.asarray(bump, jnp.float32))
        return se.line_field(kind, gbuffer, se.describe(gbuffer), sigma=sigma)

    used = []
    monkeypatch.setattr(smoothing, "list_tiles", lambda *a, **k: used.append(list_tiles(*a, **k)) or used[-1])
    tiled = field()
    assert used[-1] is not None
    monkeypatch.setattr(smoothing, "list_tiles", lambda *_, **__: None)
    whole = field()
    known = np.asarray(whole.height) > (1e-6 if kind == "own" else 0)  # there directions of tiny heights are kept
    for name in ("height", "direction", "singularity"):
        ours, expected = (np.asarray(getattr(f, name)) for f in (tiled, whole))
        every = name == "height" or kind != "own"
        np.testing.assert_allclose(*(a if every else a[known] for a in (ours, expected)), atol=1e-6)


# ------------------------------------------------------------------------------------------- gradients, edge cases


SLOWER = [pytest.param(k, marks=pytest.mark.slow) for k in ("occlusion", "surface", "luminance", "ridge", "inflection")]


@pytest.mark.parametrize("kind", ["valley", *SLOWER])
def test_gradients_are_finite_and_the_mask_is_kept(kind):
    gbuffer = disc_before_wall(wall=False)
    normal = jnp.where(gbuffer.mask[..., None], gbuffer.normal, jnp.nan)
    d = se.describe(replace(gbuffer, normal=normal))
    image = {"luminance": gbuffer.depth} if kind == "luminance" else {}

    def value(hessian):
        field = se.line_field(kind, gbuffer, replace(d, hessian=hessian), **image)
        return jnp.sum(field.height) + jnp.sum(field.direction) + jnp.sum(field.singularity)

    assert np.all(np.isfinite(jax.grad(value)(d.hessian)))
    field = se.line_field(kind, gbuffer, d, **image)
    assert all(np.all(np.isfinite(a)) for a in (field.height, field.direction, field.singularity))
    off = ~np.asarray(gbuffer.mask)
    if kind != "occlusion":
        assert not np.any(np.asarray(field.height)[off])
        assert not np.any(np.asarray(field.direction)[off])
        assert np.all(np.asarray(field.singularity)[off] == 1)


@pytest.mark.parametrize("shape", [(1, 1), (6, 1)])
def test_thin_images(shape):
    height = np.ones(shape, np.float32)
    field = se.make_line_field(height, np.zeros((*shape, 2), np.float32), sigma=1.0)
    assert np.all(np.isfinite(field.height))
    assert not np.any(se.fit_profile(field).valid)
    field = se.line_field("luminance", None, None, luminance=height)
    assert np.all(np.isfinite(field.singularity))


def test_bad_arguments_are_named():
    gbuffer, _ = fold(0.0, 1)
    d = se.describe(gbuffer)
    with pytest.raises(ValueError, match="kind is 'crest'; accepted are 'occlusion'"):
        se.line_field("crest", gbuffer, d)
    with pytest.raises(ValueError, match="kind is 'crest'"):
        se.fit_radius("crest")
    with pytest.raises(ValueError, match="luminance is not given"):
        se.line_field("luminance", gbuffer, d)
    with pytest.raises(ValueError, match="luminance is given"):
        se.line_field("ridge", gbuffer, d, luminance=gbuffer.depth)
    with pytest.raises(ValueError, match="sigma"):
        se.line_field("ridge", gbuffer, d, sigma=-1.0)
    with pytest.raises(ValueError, match="accepted is a GBuffer"):
        se.line_field("ridge", None, d)
    with pytest.raises(ValueError, match="direction has shape"):
        se.make_line_field(np.ones((4, 5)), np.ones((5, 4, 2)))
