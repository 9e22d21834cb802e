"""Files: meshes of every format, environment maps, pictures, and plain errors."""

import numpy as np
import pytest
import trimesh

import shapeenh as se


def export(path, mesh, **options):
    trimesh.Trimesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), process=False).export(path, **options)
    return path


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "off", "glb"])
def test_every_format_gives_the_same_smooth_mesh(suffix, tmp_path):
    original = se.torus(segments=16)
    mesh = se.load_mesh(export(tmp_path / f"torus.{suffix}", original))
    assert mesh.faces.shape == original.faces.shape
    assert mesh.vertices.shape == original.vertices.shape  # the triangle soup of STL is welded
    corners = lambda m: np.asarray(m.vertices)[np.asarray(m.faces)]  # noqa: E731
    np.testing.assert_allclose(corners(mesh), corners(original), atol=1e-5)
    own = se.vertex_normals(original.vertices, original.faces)
    np.testing.assert_allclose(
        np.asarray(mesh.normals)[np.asarray(mesh.faces)], np.asarray(own)[np.asarray(original.faces)], atol=2e-3
    )


def test_normals_of_the_file_are_kept(tmp_path):
    path = tmp_path / "quad.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0.6 0.8\nf 1//1 2//1 3//1 4//1\n")
    mesh = se.load_mesh(path)
    assert mesh.faces.shape == (2, 3)  # the polygon is triangulated
    np.testing.assert_allclose(mesh.normals, np.tile([0, 0.6, 0.8], (4, 1)), atol=1e-6)


def test_texture_seams_do_not_split_normals_and_uv_is_kept(tmp_path):
    path = tmp_path / "seam.obj"
    path.write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0.5\nv 0 1 0.5\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvt 0.5 0.5\nvt 0.2 0.2\n"
        "f 1/1 2/2 3/3\nf 1/5 3/6 4/4\n"
    )
    mesh = se.load_mesh(path)
    assert mesh.uv.shape == (6, 2)
    vertices, normals = np.asarray(mesh.vertices), np.asarray(mesh.normals)
    for p in np.unique(vertices, axis=0):
        same = normals[np.all(vertices == p, axis=1)]
        np.testing.assert_allclose(same, np.tile(same[0], (len(same), 1)), atol=1e-6)


def test_creases_split_normals_only_at_sharp_edges(tmp_path):
    box = trimesh.creation.box()
    box.export(tmp_path / "box.off")
    smooth = se.load_mesh(tmp_path / "box.off")
    sharp = se.load_mesh(tmp_path / "box.off", crease_degrees=40)
    assert smooth.vertices.shape == (8, 3)
    assert sharp.vertices.shape == (24, 3)
    np.testing.assert_allclose(np.abs(np.asarray(sharp.normals)).max(axis=1), 1, atol=1e-6)
    assert se.load_mesh(tmp_path / "box.off", crease_degrees=100).vertices.shape == (8, 3)


def test_vertex_colours_become_linear(tmp_path):
    path = tmp_path / "c.ply"
    body = trimesh.creation.icosphere(1)
    body.visual.vertex_colors = np.tile(np.uint8([188, 0, 255, 255]), (len(body.vertices), 1))
    body.export(path)
    np.testing.assert_allclose(se.load_mesh(path).colors[0], [0.503, 0, 1], atol=2e-3)


def test_scenes_are_merged(tmp_path):
    scene = trimesh.Scene()
    for k in range(3):
        scene.add_geometry(
            trimesh.creation.icosphere(1), transform=trimesh.transformations.translation_matrix([3 * k, 0, 0])
        )
    scene.export(tmp_path / "three.glb")
    mesh = se.load_mesh(tmp_path / "three.glb")
    assert mesh.faces.shape == (240, 3)
    np.testing.assert_allclose(np.asarray(mesh.vertices).max(axis=0)[0], 7, atol=1e-5)


def test_large_coordinates_are_recentred_before_float32(tmp_path):
    torus = se.torus(segments=8)
    offset = np.array([4.5e6, 5.2e6, 300.0])
    body = trimesh.Trimesh(np.asarray(torus.vertices, np.float64) + offset, np.asarray(torus.faces), process=False)
    (tmp_path / "far.obj").write_text(trimesh.exchange.obj.export_obj(body, digits=9))
    with pytest.warns(UserWarning, match=r"far from the origin; it was moved by \(-4.5e\+06"):
        mesh = se.load_mesh(tmp_path / "far.obj")
    corners = lambda m: np.asarray(m.vertices)[np.asarray(m.faces)]  # noqa: E731
    span = corners(mesh) - corners(mesh)[:1, :1]
    np.testing.assert_allclose(span, corners(torus) - corners(torus)[:1, :1], atol=1e-5)


def test_nan_vertices_are_counted_and_their_faces_dropped(tmp_path):
    path = tmp_path / "nan.obj"
    path.write_text("v 0 0 nan\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 2 3 4\n")
    with pytest.warns(UserWarning, match="1 vertices that are NaN or infinite; 1 faces"):
        mesh = se.load_mesh(path)
    assert mesh.faces.shape == (1, 3)
    assert np.all(np.isfinite(mesh.vertices))
    path.write_text("v 0 0 nan\nv 1 0 0\nv 1 1 0\nf 1 2 3\n")
    with pytest.raises(ValueError, match="every face uses one"):
        se.load_mesh(path)


@pytest.mark.parametrize(
    ("name", "content", "error", "words"),
    [
        ("none.obj", None, FileNotFoundError, "none.obj does not exist"),
        ("mesh.xyz", b"0 0 0", ValueError, "suffix '.xyz'; accepted are meshes .obj"),
        ("a.obj", b"hello\n", ValueError, "no triangles"),
        ("a.ply", b"hello\n", ValueError, "cannot be read as a PLY mesh"),
        ("a.glb", b"hello\n", ValueError, "cannot be read as a GLB mesh"),
        ("a.stl", b"", ValueError, "no triangles|cannot be read"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 9\n", ValueError, "cannot be read as a OBJ mesh"),
    ],
)
def test_bad_meshes(name, content, error, words, tmp_path):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(error, match=words):
        se.load_mesh(path)


def test_a_folder_is_not_a_mesh(tmp_path):
    with pytest.raises(ValueError, match="is not a file"):
        se.load_mesh(tmp_path)


@pytest.mark.parametrize("suffix", ["exr", "hdr"])
def test_environment_maps_keep_their_radiance(suffix, tmp_path, rng):
    radiance = np.float32(rng.lognormal(size=(16, 32, 3)) * 10)
    se.save_image(tmp_path / f"map.{suffix}", radiance)
    back = se.load_environment(tmp_path / f"map.{suffix}")
    assert back.dtype == np.float32
    largest = radiance.max(axis=-1, keepdims=True)
    assert np.all(np.abs(back - radiance) <= largest * (1 / 128 if suffix == "hdr" else 1e-3))


def test_eight_bit_environment_is_decoded_from_srgb(tmp_path):
    se.save_image(tmp_path / "map.png", np.full((4, 8, 3), 188, np.uint8))
    np.testing.assert_allclose(se.load_environment(tmp_path / "map.png"), 0.503, atol=2e-3)


def test_saved_pictures_are_srgb_encoded_once(tmp_path):
    image = np.zeros((5, 7, 3))
    image[0, :, 0] = 2.0  # clipped
    image[4, :, 1] = 0.2140  # half of the display range
    se.save_image(tmp_path / "p.png", image)
    back = se.load_image(tmp_path / "p.png")
    assert back.shape == (5, 7, 3)
    assert back.dtype == np.uint8
    assert tuple(back[0, 3]) == (255, 0, 0)
    assert abs(int(back[4, 3, 1]) - 127) <= 1
    se.save_image(tmp_path / "p16.png", image, bits=16)
    deep = se.load_image(tmp_path / "p16.png")
    assert deep.dtype == np.uint16
    assert abs(deep[4, 3, 1] / 65535 - 0.5) < 1e-3


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda p: se.save_image(p / "no" / "a.png", np.zeros((2, 2, 3))), FileNotFoundError, "no does not exist"),
        (lambda p: se.save_image(p / "a.png", np.zeros((2, 2, 5))), ValueError, r"\(2, 2, 5\)"),
        (lambda p: se.save_image(p / "a.png", np.full((2, 2, 3), np.nan)), ValueError, "NaN"),
        (lambda p: se.save_image(p / "a.xyz", np.zeros((2, 2, 3))), ValueError, r"\.xyz"),
        (lambda p: se.load_environment(p / "a.hdr"), FileNotFoundError, "does not exist"),
    ],
)
def test_bad_images(call, error, words, tmp_path):
    with pytest.raises(error, match=words):
        call(tmp_path)


@pytest.mark.parametrize("suffix", ["png", "hdr", "exr", "tif"])
def test_garbage_is_no_image(suffix, tmp_path):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"this is not an image, whatever its name says")
    with pytest.raises(ValueError, match="cannot be read as an image"):
        se.load_environment(path)
