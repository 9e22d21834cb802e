"""Smooth outlines: samples per pixel borrow shading (Chajdas et al. 2011); laws, the brute-force twin, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import shapeenh as se
from shapeenh import Coverage, Mesh, rasterize, render_gbuffer, resolve_coverage, sample_coverage
from shapeenh.types import replace
from tests.reference import coverage as twin
from tests.test_visibility import H, W, cast, make, pixel_camera, soup

SIZE = {"height": H, "width": W}


def normals_of(mesh):
    """The mesh with flat normals, one per face; its corners are not shared."""
    v, f = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    across = np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
    normal = np.zeros(v.shape)
    normal[f.ravel()] = np.repeat(across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30), 3, axis=0)
    normal[(normal == 0).all(1), 2] = 1
    return replace(mesh, normals=jnp.asarray(normal, mesh.vertices.dtype))


def ball(dtype=np.float32):
    solid = trimesh.creation.icosphere(subdivisions=3)
    mesh = make(solid.vertices, solid.faces, dtype)
    return replace(mesh, normals=mesh.vertices + jnp.asarray([0, 0, 1e-3], dtype)[None])


def flat(polygons, dtype=np.float32):
    """Convex polygons [n, 2] px at heights z, facing the viewer of `pixel_camera`."""
    vertices, faces = np.zeros((0, 3)), []
    for points, z in polygons:
        first = len(vertices)
        faces += [(first, first + k, first + k + 1) for k in range(1, len(points) - 1)]
        vertices = np.concatenate([vertices, np.c_[points, np.full(len(points), z)]])
    mesh = make(vertices, faces, dtype)
    return replace(mesh, normals=jnp.zeros_like(mesh.vertices).at[:, 2].set(1))


def circle(radius, centre=(0.0, 0.0), count=48):
    t = np.arange(count) * 2 * np.pi / count
    return np.c_[centre[0] + radius * np.cos(t), centre[1] + radius * np.sin(t)]


SQUARE = 99.0 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])


def sampled(mesh, camera, samples, **options):
    """G-buffer, coverage, and the ids at S x S samples per pixel, [H, W, S * S]."""
    g = render_gbuffer(mesh, camera, **SIZE, **options)
    fine = np.asarray(rasterize(mesh, camera, height=H * samples, width=W * samples, **options).triangle)
    blocks = fine.reshape(H, samples, W, samples).transpose(0, 2, 1, 3).reshape(H, W, samples**2)
    return g, sample_coverage(mesh, camera, g, samples=samples, **options), fine, blocks


# ------------------------------------------------------------------------------------------- the fraction


@pytest.mark.parametrize("samples", [pytest.param(2, marks=pytest.mark.thorough), 4])
def test_the_fraction_is_the_number_of_covered_samples(rng, samples):
    mesh, camera = ball(), se.perspective_camera((1, 2, 3), (0.1, 0, 0), fov_degrees=30, aspect=W / H)
    g, coverage, _, blocks = sampled(mesh, camera, samples)
    assert coverage.source.shape == (H, W, samples**2)
    assert coverage.source.dtype == np.int8
    share = (blocks >= 0).mean(-1)
    assert np.array_equal(coverage.fraction, share)  # every sample of a ball has a covered pixel near
    assert np.array_equal(np.asarray(coverage.source) >= 0, blocks >= 0)
    assert ((share > 0) & (share < 1)).sum() > 60
    inner = (share == 1) & np.asarray(g.mask)
    kept = (np.asarray(coverage.source) == 4).all(-1)
    assert kept[inner].mean() > 0.9


@pytest.mark.parametrize("samples", [2, 4])
def test_a_half_plane_has_the_area_it_covers(rng, samples):
    """Straight outlines at random angles: never off by more than a row of samples, and far less on average."""
    errors = []
    for angle in rng.uniform(0, 2 * np.pi, 8):
        normal, offset = np.array([np.cos(angle), np.sin(angle)]), rng.uniform(-5, 5)
        along = np.array([-normal[1], normal[0]])
        corner = normal * offset
        mesh = flat([(np.array([corner - 99 * along, corner + 99 * along, corner + 99 * along - 99 * normal,
                                corner - 99 * along - 99 * normal]), 0.0)])  # fmt: skip
        g, coverage, _, _ = sampled(mesh, pixel_camera(), samples)
        n = 64
        t = (np.arange(n) + 0.5) / n
        y = H / 2 - (np.arange(H)[:, None] + t[None]).reshape(-1)
        x = (np.arange(W)[:, None] + t[None]).reshape(-1) - W / 2
        inside = (normal[0] * x[None] + normal[1] * y[:, None]) < offset
        area = inside.reshape(H, n, W, n).mean((1, 3))
        errors.append((np.asarray(coverage.fraction) - area)[(area > 0) & (area < 1)])
        # the picture of a constant is the constant times the fraction
        color = np.array([0.25, 2.0, 7.0], np.float32)
        image = np.where(np.asarray(g.mask)[..., None], color, 0)
        assert np.allclose(
            resolve_coverage(image, coverage), color * np.asarray(coverage.fraction)[..., None], rtol=1e-6
        )
    errors = np.concatenate(errors)
    assert np.abs(errors).max() <= 0.75 / samples
    assert np.sqrt((errors**2).mean()) <= 0.35 / samples
    assert abs(errors.mean()) < 0.02


def test_one_sample_is_the_mask(rng):
    mesh, camera = ball(), se.perspective_camera((1, 2, 3), (0.1, 0, 0), fov_degrees=30, aspect=W / H)
    g = render_gbuffer(mesh, camera, **SIZE)
    coverage = sample_coverage(mesh, camera, g, samples=1)
    assert np.array_equal(coverage.fraction, g.mask)
    image = jnp.where(g.mask[..., None], jnp.asarray(rng.uniform(size=(H, W, 3)), jnp.float32), 0)
    assert np.array_equal(resolve_coverage(image, coverage), image)


# ------------------------------------------------------------------------------------------- whose shading


@pytest.mark.parametrize("samples", [2, 4])
def test_a_plane_gives_the_image_back_bit_for_bit(rng, samples):
    """One plane over the whole frame, steep and in many faces: no sample leaves its pixel."""
    mesh = flat([(SQUARE, 0.0)])
    tilted = replace(mesh, vertices=mesh.vertices.at[:, 2].set(2.5 * mesh.vertices[:, 0]))
    tilted = replace(tilted, normals=jnp.broadcast_to(jnp.asarray([-2.5, 0, 1]) / np.sqrt(7.25), mesh.normals.shape))
    image = jnp.asarray(rng.normal(size=(H, W, 3)), jnp.float32)
    for one in (mesh, tilted):
        _, coverage, _, _ = sampled(one, pixel_camera(), samples)
        assert (np.asarray(coverage.source) == 4).all()
        assert np.array_equal(resolve_coverage(image, coverage), image)


@pytest.mark.parametrize("samples", [2, 4])
def test_an_inner_outline_blends_the_two_surfaces(samples):
    """A disc before a plane: every pixel is the mean of the two colours by the share of samples on the disc."""
    mesh = flat([(circle(14.3, (1.2, -0.7)), 12.0), (SQUARE, 0.0)])
    g, coverage, _, blocks = sampled(mesh, pixel_camera(), samples)
    disc = np.asarray(g.depth) < 95
    front, back = np.array([4.0, 0.5, 0.0]), np.array([0.0, 1.0, 2.0])
    image = jnp.asarray(np.where(disc[..., None], front, back), jnp.float32)
    share = (blocks < 46).mean(-1)[..., None]  # the disc has 46 faces
    assert ((share > 0) & (share < 1)).sum() > 40
    np.testing.assert_allclose(resolve_coverage(image, coverage), share * front + (1 - share) * back, rtol=1e-6)
    assert (np.asarray(coverage.fraction) == 1).all()


def test_a_crease_is_an_edge_too():
    """Two walls of a roof share their ridge: nothing jumps in depth, but a sample borrows from its own side."""
    ridge = 0.3
    left = np.array([(-99, -99), (ridge, -99), (ridge, 99), (-99, 99)])
    right = np.array([(ridge, -99), (99, -99), (99, 99), (ridge, 99)])
    mesh = flat([(left, 0.0), (right, 0.0)])
    x = mesh.vertices[:, 0]
    side = jnp.where(jnp.arange(x.shape[0]) < 4, 1.0, -1.0)
    mesh = replace(mesh, vertices=mesh.vertices.at[:, 2].set(-jnp.abs(x - ridge)))
    mesh = replace(mesh, normals=jnp.stack([-side, 0 * x, jnp.ones_like(x)], -1) / np.sqrt(2))
    g, coverage, _, blocks = sampled(mesh, pixel_camera(), 4)
    image = jnp.where(g.normal[..., :1] < 0, 1.0, 0.0)
    assert np.array_equal(resolve_coverage(image, coverage)[..., 0], (blocks < 2).mean(-1))
    assert 0 < resolve_coverage(image, coverage)[0, W // 2, 0] < 1


def twin_scene(name, rng, dtype):
    if name == "ball":
        return ball(dtype), cast(se.perspective_camera((1, 2, 3), (0.1, 0, 0), fov_degrees=30, aspect=W / H), dtype)
    vertices, faces = soup(rng, 60, 0.5)
    camera = se.orthographic_camera((1, 2, 3), (0, 0, 0), height=4.0, aspect=W / H)
    if name == "perspective":
        camera = se.perspective_camera((0, 0.5, 4), (0, 0, 0), fov_degrees=50, aspect=W / H)
    return normals_of(make(vertices, faces, dtype)), cast(camera, dtype)


@pytest.mark.parametrize("name", [pytest.param("ball", marks=pytest.mark.thorough), "parallel", "perspective"])
def test_against_the_twin(x64, rng, name):
    mesh, camera = twin_scene(name, rng, x64)
    g, coverage, fine, blocks = sampled(mesh, camera, 2)
    source = np.asarray(coverage.source)
    keeps, scores = twin.scores(mesh, camera, g.mask, g.position, g.normal, fine, 2)
    assert (source[keeps] == 4).all()
    assert (source[blocks < 0] == -1).all()
    other = (blocks >= 0) & ~keeps[..., None]
    lost = other & (scores.min(-1) == 9)
    assert (source[lost] == -1).all()
    chosen = np.take_along_axis(scores, np.maximum(source, 0)[..., None], -1)[..., 0]
    decided = other & ~lost
    assert (source[decided] >= 0).all()
    assert (chosen[decided] <= scores.min(-1)[decided] + 1e-9).all()
    assert decided.sum() > 200
    share = (source >= 0).mean(-1)
    assert np.array_equal(np.asarray(coverage.fraction), share)
    assert (source[decided] != 4).mean() > 0.04


def test_both_precisions_agree(rng):
    narrow = sampled(*twin_scene("perspective", rng, np.float32), 2)[1]
    with jax.enable_x64(True):
        wide = sampled(*twin_scene("perspective", np.random.default_rng(20090803), np.float64), 2)[1]
        assert (np.asarray(narrow.source) == np.asarray(wide.source)).mean() > 0.995


def test_a_wire_between_the_pixel_centres_is_background():
    """Where no pixel around shows anything there is no shading to borrow; before a plane the wire takes the plane's."""
    wire = np.array([(-20.0, 0.2), (20.0, 0.2), (20.0, 0.3), (-20.0, 0.3)])
    alone, before = flat([(wire, 5.0)]), flat([(wire, 5.0), (SQUARE, 0.0)])
    _, coverage, _, blocks = sampled(alone, pixel_camera(), 2)
    assert (blocks >= 0).any()
    assert (np.asarray(coverage.source) == -1).all()
    assert (np.asarray(coverage.fraction) == 0).all()
    _, coverage, _, _ = sampled(before, pixel_camera(), 2)
    assert (np.asarray(coverage.source) == 4).all()


@pytest.mark.thorough
def test_culling_reaches_the_samples():
    mesh, camera = ball(), se.perspective_camera((0.2, 0, 0), (1, 0, 0), fov_degrees=60, aspect=W / H)
    _, coverage, _, _ = sampled(mesh, camera, 2, cull="back")
    assert (np.asarray(coverage.fraction) == 0).all()
    _, coverage, _, _ = sampled(mesh, camera, 2, cull="front")
    assert (np.asarray(coverage.fraction) == 1).all()


# ------------------------------------------------------------------------------------------- the picture


def random_source(rng):
    """Coverage of which a quarter of the pixels is mixed, with nothing borrowed from outside of the image."""
    source = np.where(rng.uniform(size=(H, W, 1)) < 0.5, 4, -1) * np.ones((1, 1, 4), int)
    mixed = rng.uniform(size=(H, W)) < 0.25
    source[mixed] = rng.integers(-1, 9, (mixed.sum(), 4))
    y, x = np.mgrid[:H, :W][..., None]
    v, u = y + source // 3 - 1, x + source % 3 - 1
    source = np.where((source >= 0) & ((v < 0) | (v >= H) | (u < 0) | (u >= W)), -1, source)
    return Coverage(source=jnp.asarray(source, jnp.int8), fraction=jnp.asarray((source >= 0).mean(-1), jnp.float32))


def test_the_picture_against_the_twin_and_its_gradient(dtype, rng):
    coverage = random_source(rng)
    image, cotangent = (jnp.asarray(rng.normal(size=(H, W, 3)), dtype) for _ in range(2))
    got = resolve_coverage(image, coverage)
    eps = np.finfo(dtype).eps
    np.testing.assert_allclose(got, twin.resolve(image, np.asarray(coverage.source)), atol=20 * eps)
    # linear: <c, R x> = <R' c, x>, for every single pixel of x
    grad = jax.grad(lambda image: jnp.vdot(cotangent, resolve_coverage(image, coverage)))(image)
    want = np.zeros((H, W, 3))
    source = np.asarray(coverage.source)
    for y, x, s in zip(*np.nonzero(source >= 0), strict=True):
        k = int(source[y, x, s])
        want[y + k // 3 - 1, x + k % 3 - 1] += np.asarray(cotangent, np.float64)[y, x] / 4
    np.testing.assert_allclose(grad, want, atol=50 * eps)


def test_bad_pixels_poison_only_who_borrows_from_them(rng):
    coverage = random_source(rng)
    image = jnp.asarray(rng.normal(size=(H, W, 3)), jnp.float32)
    bad = image.at[10, 10].set(jnp.nan).at[30, 40].set(jnp.inf)
    clean, spoilt = np.asarray(resolve_coverage(image, coverage)), np.asarray(resolve_coverage(bad, coverage))
    touched = ~np.isfinite(spoilt).all(-1)
    source = np.asarray(coverage.source)
    for y, x in zip(*np.nonzero(touched), strict=True):
        takes = {(y + k // 3 - 1, x + k % 3 - 1) for k in source[y, x] if k >= 0}
        assert takes & {(10, 10), (30, 40)}
    assert np.array_equal(clean[~touched], spoilt[~touched])


@pytest.mark.thorough
def test_compiled_is_eager_and_vmap_is_a_loop(rng):
    mesh = ball()
    views = [se.perspective_camera(eye, (0, 0, 0), fov_degrees=30, aspect=W / H) for eye in ((1, 2, 3), (3, 0, 1))]
    image = jnp.asarray(rng.uniform(size=(H, W, 3)), jnp.float32)

    def picture(camera):
        g = render_gbuffer(mesh, camera, **SIZE)
        return resolve_coverage(image, sample_coverage(mesh, camera, g, samples=2))

    straight = [np.asarray(picture(camera)) for camera in views]
    compiled = jax.jit(picture)
    stacked = jax.vmap(picture)(jax.tree.map(lambda *a: jnp.stack(a), *views))
    for one, camera, other in zip(straight, views, stacked, strict=True):
        np.testing.assert_allclose(compiled(camera), one, atol=1e-6)
        np.testing.assert_allclose(other, one, atol=1e-6)


def test_only_sizes_and_samples_recompile(compilations):
    mesh = ball()
    for eye in ((1, 2, 3), (-2, 1, 3), (0, 4, 1)):
        camera = se.perspective_camera(eye, (0, 0, 0), fov_degrees=35, aspect=W / H)
        g = render_gbuffer(mesh, camera, **SIZE)
        coverage = sample_coverage(replace(mesh, vertices=mesh.vertices * 0.9), camera, g, samples=2)
        resolve_coverage(g.normal, coverage)
        if eye == (1, 2, 3):
            compilations.clear()
    assert not {"jit(sources)", "jit(resolved)", "jit(visible_triangles)", "jit(resolve_gbuffer)"} & set(compilations)


def test_render_with_samples():
    mesh, camera = ball(), se.perspective_camera((1, 2, 3), (0.1, 0, 0), fov_degrees=30, aspect=W / H)
    lights, material = se.sample_environment(se.procedural_studio(), 8), se.named_material("plaster")
    plain = se.render(mesh, camera, lights, material, **SIZE)
    assert np.array_equal(se.render(mesh, camera, lights, material, samples=1, **SIZE), plain)
    smooth = se.render(mesh, camera, lights, material, samples=2, **SIZE)
    g = render_gbuffer(mesh, camera, **SIZE)
    coverage = sample_coverage(mesh, camera, g, samples=2)
    assert np.array_equal(smooth, resolve_coverage(plain, coverage))
    assert (np.asarray(smooth)[np.asarray(coverage.fraction) == 0] == 0).all()
    gradient = jax.grad(lambda m: jnp.sum(se.render(mesh, camera, lights, m, samples=2, **SIZE)))(material)
    assert np.isfinite(np.asarray(gradient.diffuse)).all()
    assert (np.asarray(gradient.diffuse) > 0).all()


# ------------------------------------------------------------------------------------------- edges


@pytest.mark.slow
def test_small_images_and_empty_meshes():
    mesh, camera = ball(), se.perspective_camera((0, 0, 4), (0, 0, 0), fov_degrees=10, aspect=1.0)
    g = render_gbuffer(mesh, camera, height=1, width=1)
    coverage = sample_coverage(mesh, camera, g, samples=2)
    assert (np.asarray(coverage.source) == 4).all()
    assert np.array_equal(resolve_coverage(g.normal, coverage), g.normal)
    nothing = Mesh(jnp.zeros((0, 3)), jnp.zeros((0, 3), jnp.int32), jnp.zeros((0, 3)))
    g = render_gbuffer(nothing, camera, height=2, width=3)
    coverage = sample_coverage(nothing, camera, g, samples=2)
    assert (np.asarray(coverage.source) == -1).all()
    assert (np.asarray(resolve_coverage(g.normal, coverage)) == 0).all()


def test_errors_name_the_argument():
    mesh, camera = ball(), pixel_camera()
    g = render_gbuffer(mesh, camera, **SIZE)
    for call, message in (
        (lambda: sample_coverage(mesh, camera, g, samples=0), "samples is 0; accepted are integers from 1 to 8"),
        (lambda: sample_coverage(mesh, camera, g, samples=2.0), "samples is 2.0"),
        (lambda: sample_coverage(mesh, camera, g.normal, samples=2), "gbuffer is a"),
        (lambda: se.render(mesh, camera, None, None, samples=9, **SIZE), "samples is 9"),
        (
            lambda: resolve_coverage(g.normal[:5], random_source(np.random.default_rng(0))),
            r"image has shape \(5, 64, 3\)",
        ),
        (lambda: resolve_coverage(g.normal, g), "coverage is a GBuffer; accepted is a Coverage"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
