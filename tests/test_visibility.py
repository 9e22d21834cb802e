"""The rasteriser: exactness laws, a brute-force twin, and the edges of its inputs (SPEC 11)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial import Delaunay

from shapeenh import Camera, Mesh, orthographic_camera, perspective_camera, rasterize
from shapeenh.buffers.project import clip_matrix, project
from shapeenh.types import replace
from tests.reference import raster as twin

# One image size and one mesh size for nearly all tests, here and elsewhere, so that they share what is compiled.
H, W = 48, 64
VERTICES = FACES = 1280

# ------------------------------------------------------------------------------------------- scenes


def make(vertices, faces, dtype=np.float32):
    """A mesh padded to few sizes (spare vertices, faces without area), so that the tests share what is compiled."""
    vertices, faces = np.asarray(vertices, np.float64).reshape(-1, 3), np.asarray(faces, np.int32).reshape(-1, 3)
    if len(faces):
        vertices = np.concatenate([vertices, np.zeros((-len(vertices) % VERTICES, 3))])
        faces = np.concatenate([faces, np.zeros((-len(faces) % FACES, 3), np.int32)])
    return Mesh(jnp.asarray(vertices, dtype), jnp.asarray(faces), jnp.zeros(vertices.shape, dtype))


def cast(camera, dtype):
    return Camera(jnp.asarray(camera.view, dtype), jnp.asarray(camera.projection, dtype))


def pixel_camera(dtype=np.float32, height=H, width=W):
    """Orthographic, world units = pixels, origin in the middle of the image, looking down -z from z = 100."""
    view = np.eye(4)
    view[2, 3] = -100
    return Camera(jnp.asarray(view, dtype), jnp.asarray(np.diag([2 / width, 2 / height, -1 / 100, 1]), dtype))


def tessellation(rng, half, count, angle=0.0):
    """A turned square [-half, half]^2 at z = 0 cut into random triangles (counter-clockwise)."""
    inner = rng.uniform(-half, half, (count, 2))
    rim = np.linspace(-half, half, 7)
    edge = np.concatenate([[(t, s), (s, t)] for t in rim for s in (-half, half)])
    points = np.unique(np.concatenate([inner, edge]), axis=0)
    faces = Delaunay(points).simplices
    u, v = points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]]
    flip = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] < 0
    faces[flip] = faces[flip][:, ::-1]
    c, s = np.cos(angle), np.sin(angle)
    return np.c_[points @ np.array([[c, s], [-s, c]]), np.zeros(len(points))], faces


def soup(rng, count, size, spread=1.0):
    centre = rng.uniform(-spread, spread, (count, 1, 3))
    vertices = (centre + size * rng.normal(size=(count, 3, 3))).reshape(-1, 3)
    return vertices, np.arange(3 * count).reshape(-1, 3)


def ids(mesh, camera, height=H, width=W, **options):
    return np.asarray(rasterize(mesh, camera, height=height, width=width, **options).triangle)


def hits(mesh, camera):
    """How many faces cover each pixel, each drawn alone."""
    total = np.zeros((H, W), int)
    for face in np.unique(np.asarray(mesh.faces), axis=0):
        alone = np.zeros(mesh.faces.shape, np.int32)
        alone[0] = face
        total += ids(Mesh(mesh.vertices, jnp.asarray(alone), mesh.normals), camera) >= 0
    return total


# ------------------------------------------------------------------------------------------- exactly once


@pytest.mark.parametrize("turn", range(8))
def test_a_split_square_is_covered_exactly_once(dtype, rng, turn):
    vertices, faces = tessellation(rng, 15.0, 40, angle=turn * np.pi / 4)
    mesh, camera = make(vertices, faces, dtype), pixel_camera(dtype)
    count = hits(mesh, camera)
    assert count.max() == 1
    assert np.array_equal(count == 1, ids(mesh, camera) >= 0)
    x, y = np.meshgrid(np.arange(W) - 31.5, 23.5 - np.arange(H))
    c, s = np.cos(turn * np.pi / 4), np.sin(turn * np.pi / 4)
    reach = np.maximum(np.abs(c * x + s * y), np.abs(c * y - s * x))
    assert (count[reach < 14.99] == 1).all()
    assert (count[reach > 15.01] == 0).all()


def test_vertices_on_pixel_centres_and_edges_through_them(dtype):
    """A grid of quads with corners on pixel centres, cut along both diagonals: every edge hits pixel centres."""
    n = 9
    x, y = np.meshgrid(np.arange(n) - 4.5, np.arange(n) - 4.5)
    vertices = np.stack([x, y, 0 * x], -1).reshape(-1, 3)
    faces = []
    for i in range(n - 1):
        for j in range(n - 1):
            a, b, c, d = i * n + j, i * n + j + 1, (i + 1) * n + j + 1, (i + 1) * n + j
            faces += [(a, b, c), (a, c, d)] if (i + j) % 2 else [(a, b, d), (b, c, d)]
    mesh, camera = make(vertices, faces, dtype), pixel_camera(dtype)
    count = hits(mesh, camera)
    # corners on the centres of columns 27 to 35 and rows 20 to 28: the left and the upper border are kept
    expected = np.zeros((H, W), int)
    expected[20:28, 27:35] = 1
    assert np.array_equal(count, expected)


@pytest.mark.parametrize("size", [1.5, 6.0, 30.0, 90.0, 500.0])
def test_faces_of_every_size_class_meet_without_a_gap(rng, size):
    """Two faces of one quad, through the tiny, small, large and off-screen code, at 16 random positions."""
    camera = pixel_camera()
    for _ in range(16):
        corner = rng.uniform(-24, 24, 2)
        quad = (
            corner + size * np.array([(0, 0), (1, 0.1), (1.1, 1), (-0.1, 0.9)]) + rng.normal(size=(4, 2)) * 0.01 * size
        )
        mesh = make(np.c_[quad, np.zeros(4)], [(0, 1, 2), (0, 2, 3)])
        count = hits(mesh, camera)
        assert count.max(initial=0) <= 1
        swapped = make(np.c_[quad, np.zeros(4)], [(1, 2, 3), (1, 3, 0)])
        assert np.array_equal(count, hits(swapped, camera))


@pytest.mark.parametrize("turn", range(8))
def test_a_split_floor_across_the_eye_plane_is_covered_exactly_once(dtype, rng, turn):
    """The camera stands on a tessellated floor that reaches far behind it: half of the faces are cut somewhere."""
    vertices, faces = tessellation(rng, 50.0, 60, angle=turn * np.pi / 4 + 0.1)
    floor = vertices[:, [0, 2, 1]] * [1, 1, -1]
    camera = cast(perspective_camera((0.3, 1.0, 0.2), (0.1, 0.6, -3), fov_degrees=70, aspect=W / H), dtype)
    mesh = make(floor, faces, dtype)
    count = hits(mesh, camera)
    assert count.max() == 1
    whole = make(np.array([(-99, 0, -99), (99, 0, -99), (99, 0, 99), (-99, 0, 99)]), [(0, 2, 1), (0, 3, 2)], dtype)
    below = ids(whole, camera) >= 0
    assert (count[H // 2 + 4 :] == 1).all()
    assert (count <= below).all()


def test_guard_band(rng):
    """Corners just in front of an extreme near plane project 10^7 pixels away and are still drawn where they belong."""
    vertices, faces = tessellation(rng, 1e4, 40)
    floor = vertices[:, [0, 2, 1]] * [1, 1, -1] + [0, -1e-3, 0]
    camera = perspective_camera((0, 0, 0), (0, 0, -1), fov_degrees=60, aspect=1.0, near=1e-6)
    mesh = make(floor, faces)
    count = hits(mesh, camera)
    assert (count[H // 2 :] == 1).all()
    assert (count[: H // 2] == 0).all()
    want, undecided, _ = twin.rasterize(mesh.vertices, mesh.faces, camera.view, camera.projection, H, W)
    assert (np.equal(ids(mesh, camera), want) | undecided).all()
    assert undecided.mean() < 0.3


# ------------------------------------------------------------------------------------------- the twin


def scene(name, rng):
    if name == "sphere":
        ball = trimesh.creation.icosphere(subdivisions=3)
        return ball.vertices, ball.faces, perspective_camera((1, 2, 3), (0.1, 0, 0), fov_degrees=35, aspect=1.5)
    if name == "inside":
        ball = trimesh.creation.icosphere(subdivisions=2)
        camera = perspective_camera((0.3, 0.2, 0.4), (0, -1, 0.2), fov_degrees=90, aspect=1.5)
        return ball.vertices, ball.faces, camera
    if name == "parallel":
        return *soup(rng, 300, 0.2), orthographic_camera((1, 2, 3), (0, 0, 0), height=3.0, aspect=1.5)
    if name == "around":  # triangles before, behind and across the eye plane, some beyond everything
        return *soup(rng, 120, 1.5, spread=4.0), perspective_camera((0, 0, 0), (1, 0.2, -1), fov_degrees=60, aspect=1.5)
    sizes = {"dust": 0.004, "small": 0.03, "mixed": 0.3, "large": 1.0}
    return *soup(rng, 400, sizes[name]), perspective_camera((0, 0.5, 4), (0, 0, 0), fov_degrees=40, aspect=1.5)


@pytest.mark.parametrize("cull", ["none", "back", pytest.param("front", marks=pytest.mark.thorough)])
@pytest.mark.parametrize("name", ["sphere", "inside", "parallel", "around", "dust", "small", "mixed", "large"])
def test_against_brute_force(dtype, rng, name, cull):
    vertices, faces, camera = scene(name, rng)
    mesh, camera = make(vertices, faces, dtype), cast(camera, dtype)
    m, near = clip_matrix(camera.view, camera.projection)
    x, y, *_ = project(mesh.vertices, m, near, H, W)
    own = np.stack([x, y], 1)
    clip = twin.clip_coordinates(mesh.vertices, camera.view, camera.projection)
    front = (clip[:, 3] > 0) & (clip[:, 2] >= -clip[:, 3])
    shown = front & (np.abs(twin.snap(clip, H, W)).max(1) < 256 * 1000)
    # the integers are those of float64, up to float32's rounding before they are rounded
    assert np.abs(own - twin.snap(clip, H, W))[shown].max() <= (0 if dtype == np.float64 else 1)
    want, undecided, _ = twin.rasterize(
        mesh.vertices, mesh.faces, camera.view, camera.projection, H, W, cull, snapped=own
    )
    got = ids(mesh, camera, cull=cull)
    wrong = (got != want) & ~undecided
    assert not wrong.any(), f"{wrong.sum()} pixels differ"
    assert undecided.mean() < 0.1


@pytest.mark.parametrize(
    ("height", "width"),
    [
        (1, 1),
        (3, 70),
        pytest.param(65, 63, marks=pytest.mark.slow),
        *(pytest.param(*size, marks=pytest.mark.thorough) for size in [(70, 1), (257, 3), (7, 5), (1, 2), (9, 9)]),
    ],
)
def test_every_image_size(rng, height, width):
    vertices, faces = soup(rng, 30, 0.5)
    camera = perspective_camera((0, 0, 4), (0, 0, 0), fov_degrees=40, aspect=1.0)
    mesh = make(vertices, faces)
    m, near = clip_matrix(camera.view, camera.projection)
    x, y, *_ = project(mesh.vertices, m, near, height, width)
    want, undecided, _ = twin.rasterize(
        mesh.vertices, mesh.faces, camera.view, camera.projection, height, width, snapped=np.stack([x, y], 1)
    )
    assert ((ids(mesh, camera, height, width) == want) | undecided).all()


# ------------------------------------------------------------------------------------------- order


@pytest.mark.parametrize("size", [1.0, 3.0, 6.0, 40.0])
@pytest.mark.parametrize("turned", [(0, 1, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0), (0, 2, 1), (1, 0, 2)])
def test_ties_go_to_the_lowest_index(dtype, rng, size, turned):
    """A slanted face and a copy that lists its corners otherwise, or is turned over: equally near at every pixel."""
    corners = size * np.array([(-1.03, -0.97, 0.3), (1.1, -0.9, -0.2), (0.05, 1.07, 0.9)])
    for first, second in (((0, 1, 2), turned), (turned, (0, 1, 2))):
        mesh = make(np.concatenate([corners, corners + [0, 0, -1]]), [(3, 4, 5), first, second], dtype)
        seen = ids(mesh, pixel_camera(dtype))
        assert (seen != 2).all()
        assert (seen == 1).any()


def test_the_nearest_wins_whatever_the_order(rng):
    vertices, faces = soup(rng, 200, 0.3)
    camera = perspective_camera((0, 0.5, 4), (0, 0, 0), fov_degrees=40, aspect=1.0)
    straight = ids(make(vertices, faces), camera)
    order = rng.permutation(len(faces))
    shuffled = ids(make(vertices, faces[order]), camera)
    assert np.array_equal(straight, np.where(shuffled >= 0, order[shuffled], -1))


def test_depth_resolution_does_not_depend_on_the_range(dtype):
    """Two parallel squares 1e-5 of the distance apart, 10 to 10^6 near planes away, and orthographic from afar."""
    square = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], np.float64)
    faces = [(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)]
    for distance in (1.0, 30.0, 1e3, 1e5):
        scale = 0.3 * distance
        both = np.concatenate([square * scale - [0, 0, distance], square * scale - [0, 0, distance * (1 - 1e-5)]])
        camera = cast(perspective_camera((0, 0, 0), (0, 0, -1), fov_degrees=30, aspect=1.0, near=0.1), dtype)
        assert (ids(make(both, faces, dtype), camera) >= 2).all()
    both = np.concatenate([square, square + [0, 0, 1e-5]])
    camera = cast(orthographic_camera((0, 0, 1e5), (0, 0, 0), height=1.5, aspect=1.0), dtype)
    assert (ids(make(both, faces, dtype), camera) >= 2).all()


def test_culling_splits_the_faces_in_two(rng):
    dtype = np.float32
    vertices, faces, camera = scene("mixed", rng)
    mesh, camera = make(vertices, faces, dtype), cast(camera, dtype)
    back, front, none = (ids(mesh, camera, cull=c) for c in ("back", "front", "none"))
    clip = twin.clip_coordinates(vertices, camera.view, camera.projection)
    window = clip[:, :2] / clip[:, 3:]
    u, v = window[faces[:, 1]] - window[faces[:, 0]], window[faces[:, 2]] - window[faces[:, 0]]
    counter_clockwise = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] > 0
    assert counter_clockwise[back[back >= 0]].all()
    assert not counter_clockwise[front[front >= 0]].any()
    assert np.array_equal((back >= 0) | (front >= 0), none >= 0)
    assert ((none == back) | (none == front)).all()
    assert np.array_equal(ids(mesh, camera, cull=True), back)
    assert np.array_equal(ids(mesh, camera, cull=False), none)


# ------------------------------------------------------------------------------------------- cameras


def test_inside_a_closed_mesh_every_pixel_is_covered(dtype):
    ball = trimesh.creation.icosphere(subdivisions=2)
    mesh = make(ball.vertices, ball.faces, dtype)
    for target in np.random.default_rng(1).normal(size=(8, 3)):
        camera = cast(perspective_camera((0.2, -0.3, 0.1), target, fov_degrees=100, aspect=1.0), dtype)
        assert (ids(mesh, camera) >= 0).all()
        assert (ids(mesh, camera, cull="back") == -1).all()


def test_nothing_behind_the_camera_is_seen(dtype, rng):
    vertices, faces = soup(rng, 50, 0.3)
    camera = cast(perspective_camera((0, 0, -9), (0, 0, -20), fov_degrees=90, aspect=1.0), dtype)
    assert (ids(make(vertices, faces, dtype), camera) == -1).all()


@pytest.mark.parametrize("name", ["mixed", "around", "large"])
def test_an_off_centre_projection_sees_a_part_of_the_whole(rng, name):
    vertices, faces, camera = scene(name, rng)
    mesh = make(vertices, faces)
    whole = ids(mesh, camera, 2 * H, 2 * W)
    crop = np.diag([2.0, 2.0, 1.0, 1.0])
    for row, column in np.ndindex(2, 2):
        crop[:2, 3] = 1 - 2 * column, 2 * row - 1  # x' = 2 x ± w, y' = 2 y ± w: the four quarters
        quarter = Camera(camera.view, jnp.asarray(crop @ np.asarray(camera.projection, np.float64), jnp.float32))
        same = ids(mesh, quarter) == whole[H * row :, W * column :][:H, :W]
        assert same.mean() > 0.995  # float32 rounds other numbers: a corner may snap 1/256 px away


def test_the_far_plane_does_not_cut(dtype):
    near, far = 1.0, 10.0
    projection = np.array(
        [
            [2, 0, 0, 0],
            [0, 2, 0, 0],
            [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, -1, 0],
        ]
    )
    camera = Camera(jnp.eye(4, dtype=dtype), jnp.asarray(projection, dtype))
    square = np.array([(-99, -99, 0), (99, -99, 0), (99, 99, 0), (-99, 99, 0)], np.float64)
    faces = [(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)]
    mesh = make(np.concatenate([square - [0, 0, 40], square - [0, 0, 20]]), faces, dtype)
    assert (ids(mesh, camera) >= 2).all()  # both beyond the far plane, the nearer one seen


def test_the_near_plane_cuts(dtype):
    square = np.array([(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)], np.float64)
    mesh = make(square - [0, 0, 0.5], [(0, 1, 2), (0, 2, 3)], dtype)
    at = lambda near: cast(perspective_camera((0, 0, 0), (0, 0, -1), fov_degrees=60, aspect=1.0, near=near), dtype)  # noqa: E731
    assert (ids(mesh, at(0.4)) >= 0).all()
    assert (ids(mesh, at(0.6)) == -1).all()
    behind = cast(orthographic_camera((0, 0, 0), (0, 0, -1), height=2.0, aspect=1.0), dtype)
    assert (ids(make(square + [0, 0, 0.5], [(0, 1, 2)], dtype), behind) == -1).all()
    assert (ids(mesh, behind) >= 0).all()


# ------------------------------------------------------------------------------------------- transformations


def test_compiled_is_eager_and_both_precisions_agree(rng):
    vertices, faces, camera = scene("mixed", rng)
    mesh = make(vertices, faces)
    straight = ids(mesh, camera)
    compiled = jax.jit(lambda mesh, camera: rasterize(mesh, camera, height=H, width=W).triangle)(mesh, camera)
    assert np.array_equal(straight, compiled)
    with jax.enable_x64(True):
        wide = ids(make(np.asarray(mesh.vertices, np.float64), faces, np.float64), cast(camera, np.float64))
    assert (wide == straight).mean() > 0.995


@pytest.mark.thorough
def test_eager_without_jit(rng):
    """Integers leave the compiler no freedom: the same ids from single operations."""
    vertices, faces = tessellation(rng, 9.0, 12, angle=0.3)
    mesh, camera = make(vertices, faces), pixel_camera()
    straight = ids(mesh, camera)
    with jax.disable_jit():
        assert np.array_equal(straight, ids(mesh, camera))


@pytest.mark.thorough
def test_vmap_over_cameras_and_over_meshes(rng):
    vertices, faces = soup(rng, 60, 0.3)
    mesh = make(vertices, faces)
    cameras = [perspective_camera(eye, (0, 0, 0), fov_degrees=40, aspect=1.0) for eye in rng.normal(size=(3, 3)) * 3]
    stacked = jax.tree.map(lambda *a: jnp.stack(a), *cameras)
    views = jax.vmap(lambda camera: rasterize(mesh, camera, height=H, width=W).triangle)(stacked)
    for camera, view in zip(cameras, views, strict=True):
        assert np.array_equal(view, ids(mesh, camera))
    moved = mesh.vertices[None] + jnp.asarray([0.0, 0.1])[:, None, None]
    frames = jax.vmap(lambda v: rasterize(replace(mesh, vertices=v), cameras[0], height=H, width=W).triangle)(moved)
    assert np.array_equal(frames[0], views[0])
    assert np.array_equal(frames[1], ids(replace(mesh, vertices=moved[1]), cameras[0]))


def test_visibility_has_no_gradient(rng):
    vertices, faces = soup(rng, 20, 0.3)
    camera = perspective_camera((0, 0, 4), (0, 0, 0), fov_degrees=40, aspect=1.0)
    mesh = make(vertices, faces)

    def covered(v):
        seen = rasterize(replace(mesh, vertices=v), camera, height=H, width=W).triangle
        return jnp.sum(jnp.where(seen >= 0, 1.0, 0.0)) + jnp.sum(v)

    assert np.array_equal(jax.grad(covered)(mesh.vertices), np.ones(mesh.vertices.shape))


def test_only_shapes_and_options_recompile(rng, compilations):
    vertices, faces = soup(rng, 30, 0.3)
    camera = perspective_camera((0, 0, 4), (0, 0, 0), fov_degrees=40, aspect=1.0)
    ids(make(vertices, faces), camera)
    other = perspective_camera((0, 3, 4), (0, 0, 1), fov_degrees=60, aspect=2.0)
    compilations.clear()
    ids(make(vertices + 0.3, faces[::-1]), other)
    ids(make(vertices, faces), orthographic_camera((0, 0, 4), (0, 0, 0), height=3.0))
    assert "jit(visible_triangles)" not in compilations


# ------------------------------------------------------------------------------------------- inputs


def test_an_empty_mesh_is_background():
    camera = pixel_camera()
    for vertices in (np.zeros((0, 3)), np.zeros((3, 3))):
        assert (ids(make(vertices, np.zeros((0, 3))), camera) == -1).all()


def test_faces_without_area_are_skipped(dtype):
    vertices = np.array([(0, 0, 0), (5, 5, 0), (9, 9, 0), (3, 1, 0)])
    mesh = make(vertices, [(0, 1, 2), (0, 0, 3), (1, 1, 1), (0, 1, 3)], dtype)
    seen = ids(mesh, pixel_camera(dtype))
    assert set(np.unique(seen)) == {-1, 3}


@pytest.mark.parametrize("thin", [1e-1, 1e-2, 1e-3, 1e-5, 1e-9])
def test_slivers_tile_the_plane_too(dtype, rng, thin):
    """A fan of faces thinner than a pixel between two wide ones: no hole, no double hit."""
    steps = thin * np.arange(12)
    left, right = np.array([-15.3, -2.1, 0]), np.array([15.2, 3.3, 0])
    middle = [left + (right - left) * 0.4 + [0, s, 0] for s in steps]
    vertices = np.array([left, right, (0, -14, 0), (0.5, 14, 0), *middle])
    faces = [(2, 1, 4), (2, 4, 0), (3, 0, 15), (3, 15, 1)]
    for k in range(4, 15):
        faces += [(0, k, k + 1), (1, k + 1, k)]
    mesh, camera = make(vertices, faces, dtype), pixel_camera(dtype)
    count = hits(mesh, camera)
    assert count.max() == 1
    outline = make(vertices[:4], [(0, 2, 1), (0, 1, 3)], dtype)
    solid = ids(outline, camera) >= 0
    assert np.array_equal(count == 1, solid)


@pytest.mark.parametrize("bad", [np.nan, *(pytest.param(b, marks=pytest.mark.slow) for b in (np.inf, -np.inf))])
def test_vertices_that_are_not_finite(rng, bad):
    vertices, faces = soup(rng, 40, 0.4)
    camera = perspective_camera((0, 0, 4), (0, 0, 0), fov_degrees=40, aspect=1.0)
    vertices[[4, 60]] = bad
    vertices[30, 1] = bad
    with pytest.raises(ValueError, match="3 NaN or infinite vertices"):
        rasterize(make(vertices, faces), camera, height=H, width=W)
    # under jit the values cannot be looked at: the faces are left out, the others are as they are
    mesh = make(vertices, faces)
    seen = jax.jit(lambda mesh: rasterize(mesh, camera, height=H, width=W).triangle)(mesh)
    good = np.isfinite(vertices).all(1)[faces].all(1)
    index = np.flatnonzero(good)
    alone = ids(make(np.nan_to_num(vertices, posinf=0, neginf=0), faces[good]), camera)
    assert np.array_equal(seen, np.where(alone >= 0, index[alone], -1))


def test_errors_name_the_argument(rng):
    vertices, faces = soup(rng, 2, 0.4)
    camera, mesh = pixel_camera(), make(vertices, faces)
    for wrong, message in (
        (
            replace(mesh, faces=faces + 1275),
            r"mesh.faces has 1 face\(s\) with an index out of range; accepted are 0 to 1279",
        ),
        (replace(mesh, faces=faces - 1), "out of range"),
        (replace(mesh, vertices=vertices[:, :2]), r"mesh.vertices has shape \(6, 2\)"),
        (Mesh(mesh.vertices, jnp.zeros((1, 3)), mesh.normals), "mesh.faces has dtype float32"),
        ("mesh", "mesh is a str; accepted is a Mesh"),
    ):
        with pytest.raises(ValueError, match=message):
            rasterize(wrong, camera, height=8, width=8)
    for options, message in (
        ({"height": 0, "width": 8}, "height is 0"),
        ({"height": 8, "width": 2.0}, "width is 2.0"),
        ({"height": 8, "width": 8, "cull": "left"}, "cull is 'left'"),
        ({"height": 8, "width": 8, "cull": 2}, "cull is 2"),
    ):
        with pytest.raises(ValueError, match=message):
            rasterize(mesh, camera, **options)
    with pytest.raises(ValueError, match=r"camera\.view holds 1 NaN"):
        rasterize(mesh, Camera(camera.view.at[0, 0].set(jnp.nan), camera.projection), height=8, width=8)


def test_numpy_arrays_are_looked_at_every_time():
    """A jax.Array cannot change and is checked once; a NumPy array can."""
    vertices = np.array([(0, 0, 0), (5, 0, 0), (0, 5, 0)], np.float32)
    vertices = np.pad(vertices, ((0, 1277), (0, 0)))
    mesh = Mesh(vertices, np.pad(np.array([(0, 1, 2)], np.int32), ((0, 1279), (0, 0))), vertices)
    camera = pixel_camera()
    assert (ids(mesh, camera) >= 0).any()
    vertices[0, 0] = np.nan
    with pytest.raises(ValueError, match="1 NaN"):
        ids(mesh, camera)
