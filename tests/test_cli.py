"""The command line, run as a user would: pictures, buffers, JSON, and one plain line for wrong input."""

import json
import re

import numpy as np
import pytest

import shapeenh as se
from shapeenh.cli import main

SMALL = ["--size", "48x36", "--lights", "8"]
COARSE = ["--size", "64x48", "--lights", "8", "--samples", "1"]  # as in other files, which share what it compiles


@pytest.fixture
def mesh_file(tmp_path):
    path = tmp_path / "torus.obj"
    torus = se.torus(segments=12)
    lines = [f"v {x} {y} {z}" for x, y, z in np.asarray(torus.vertices).tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in np.asarray(torus.faces).tolist()]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_render_writes_both_pictures_side_by_side(mesh_file, tmp_path, capsys):
    assert main(["render", str(mesh_file), "-o", str(tmp_path / "out.png"), *SMALL]) == 0
    image = se.load_image(tmp_path / "out.png")
    assert image.shape == (36, 96, 3)
    left, right = image[:, :48].astype(int), image[:, 48:].astype(int)
    assert np.abs(left - right).max() > 5  # the warp shows
    assert np.all(left[0, 0] == right[0, 0])  # and the background is the same
    assert capsys.readouterr().err == ""  # not a terminal: silent


def test_alpha_zero_shows_the_original_twice(mesh_file, tmp_path):
    assert main(["render", str(mesh_file), "-o", str(tmp_path / "o.png"), "--alpha", "0", *SMALL]) == 0
    image = se.load_image(tmp_path / "o.png").astype(int)
    assert np.abs(image[:, :48] - image[:, 48:]).max() <= 1


def test_samples_smooth_the_outlines_and_leave_the_rest(mesh_file, tmp_path):
    pictures = {}
    for samples in ("1", "4"):
        out = tmp_path / f"{samples}.png"
        common = ["render", str(mesh_file), "-o", str(out), "--only", "--background", "#ff00ff", "--samples", samples]
        assert main([*common, *SMALL]) == 0
        pictures[samples] = se.load_image(out).astype(int)
    background = lambda image: (image == [255, 0, 255]).all(axis=-1)  # noqa: E731
    plain, smooth = pictures["1"], pictures["4"]
    changed = (plain != smooth).any(axis=-1)
    assert 0.03 < changed.mean() < 0.2
    assert (background(plain) & ~background(smooth)).sum() > 20  # less than half covered
    shown = ~background(plain)
    whole = shown[1:-1, 1:-1] & shown[:-2, 1:-1] & shown[2:, 1:-1] & shown[1:-1, :-2] & shown[1:-1, 2:]
    assert changed[1:-1, 1:-1][whole].mean() < 0.1


def test_only_buffers_and_json(mesh_file, tmp_path, capsys):
    buffers = tmp_path / "buffers"
    buffers.mkdir()
    arguments = ["render", str(mesh_file), "-o", str(tmp_path / "o.png"), "--only", "--buffers", str(buffers), "--json"]
    assert main([*arguments, *SMALL]) == 0
    assert se.load_image(tmp_path / "o.png").shape == (36, 48, 3)
    assert {p.name for p in buffers.iterdir()} == {
        f"{n}.{s}" for n in ("normal", "depth", "curvature") for s in ("png", "tif")
    }
    depth = se.load_image(buffers / "depth.tif")
    normal = se.load_image(buffers / "normal.tif")
    assert depth.dtype == normal.dtype == np.float32
    assert depth.shape == (36, 48)
    np.testing.assert_allclose(np.linalg.norm(normal[depth > 0], axis=-1), 1, atol=1e-4)
    record = json.loads(capsys.readouterr().out)
    assert record["parameters"]["alpha"] == 30.0
    assert record["triangles"] == 576
    assert set(record["seconds"]["shade warped"]) == {"compile", "run"}


def test_a_terminal_is_told_what_goes_on_and_what_compiling_took(mesh_file, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    new = ["--size", "50x34", "--lights", "8", "--samples", "1"]  # what no other test has compiled
    assert main(["render", str(mesh_file), "-o", str(tmp_path / "o.png"), *new]) == 0
    said = capsys.readouterr().err
    assert "shapeenh: G-buffer ...\n" in said
    took = re.search(r"shapeenh: G-buffer: ([\d.]+) s, of which ([\d.]+) s compiling", said)
    assert 0 < float(took[2]) <= float(took[1])


def test_the_embedded_object_needs_no_file(tmp_path):
    options = ["--only", "--env", "sky", "--material", "bronze", *COARSE]
    assert main(["render", "-o", str(tmp_path / "o.png"), *options]) == 0
    assert se.load_image(tmp_path / "o.png").std() > 10


def test_a_mesh_with_nan_goes_on_with_a_warning(tmp_path, capsys):
    path = tmp_path / "nan.obj"
    path.write_text("v 0 0 nan\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 2 3 4\n")
    assert main(["render", str(path), "-o", str(tmp_path / "o.png"), *COARSE]) == 0
    assert capsys.readouterr().err.count("shapeenh: warning: ") == 1


def test_height_fields_normal_maps_and_points_are_inputs_too(tmp_path):
    y, x = np.mgrid[:36, :48]
    height = np.float32(3 * np.sin(x / 5) * np.cos(y / 5))
    height[:4, :4] = np.nan
    se.save_image(tmp_path / "relief.tif", height)
    normal = np.stack([-0.3 * np.cos(x / 5), 0 * x, np.ones(x.shape)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    se.save_image(tmp_path / "normals.png", np.uint16(np.round(65535 * (0.5 + 0.5 * normal))))
    torus = se.torus(segments=16)
    np.savetxt(tmp_path / "cloud.xyz", np.concatenate([torus.vertices, torus.normals], axis=1))
    for name, kind, options in (
        ("relief.tif", "height", ["--z-factor", "2"]),
        ("normals.png", "normals", []),
        ("cloud.xyz", "points", ["--size", "48x36", "--samples", "1"]),
    ):
        out = tmp_path / f"{kind}.png"
        common = ["--as", kind, "-o", str(out), "--lights", "8", "--alpha", "300"]
        assert main(["render", str(tmp_path / name), *common, *options]) == 0
        image = se.load_image(out).astype(int)
        assert image.shape == (36, 96, 3)
        assert np.abs(image[:, :48] - image[:, 48:]).max() > 3


def test_a_point_cloud_is_known_by_its_name_or_its_header(tmp_path):
    points = np.asarray(se.torus(segments=12).vertices)
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n" + "".join(f"property float {c}\n" for c in "xyz")
    lines = "\n".join(" ".join(map(str, p)) for p in points.tolist())
    (tmp_path / "cloud.ply").write_text(f"{header}end_header\n{lines}\n")
    np.savetxt(tmp_path / "cloud.xyz", points)
    pictures = []
    for name in ("cloud.ply", "cloud.xyz"):
        out = tmp_path / f"{name}.png"
        assert main(["render", str(tmp_path / name), "-o", str(out), "--only", "--samples", "1", *SMALL]) == 0
        pictures.append(se.load_image(out).astype(int))
    assert np.abs(pictures[0] - pictures[1]).max() <= 1
    assert pictures[0].std() > 5


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["render"], "required: -o"),
        (["render", "MISSING.obj", "-o", "OUT"], "MISSING.obj does not exist"),
        (["render", "EMPTY.obj", "-o", "OUT"], "no triangles"),
        (["render", "BROKEN.ply", "-o", "OUT"], "cannot be read as a PLY mesh"),
        (["render", "-o", "NOWHERE/o.png"], "output folder"),
        (["render", "-o", "o.xyz"], ".xyz"),
        (["render", "-o", "OUT", "--buffers", "NOWHERE"], "--buffers folder"),
        (["render", "-o", "OUT", "--json", "NOWHERE/a.json"], "--json folder"),
        (["render", "-o", "OUT", "--alpha", "nan"], "not a finite number"),
        (["render", "-o", "OUT", "--alpha", "much"], "--alpha"),
        (["render", "-o", "OUT", "--gamma", "1.5"], "--gamma is 1.5; accepted are numbers from -1 to 1"),
        (["render", "-o", "OUT", "--sigma", "-1"], "--sigma is -1"),
        (["render", "-o", "OUT", "--size", "800"], "WIDTHxHEIGHT"),
        (["render", "-o", "OUT", "--size", "0x10"], "outside 1x1"),
        (["render", "-o", "OUT", "--fov", "180"], "--fov is 180"),
        (["render", "-o", "OUT", "--view", "10"], "AZIMUTH,ELEVATION"),
        (["render", "-o", "OUT", "--view", "0,90"], "elevation 90"),
        (["render", "-o", "OUT", "--lights", "0"], "--lights is 0"),
        (["render", "-o", "OUT", "--material", "cheese"], "'cheese' is neither one of plaster"),
        (["render", "-o", "OUT", "--background", "#12"], "#RRGGBB"),
        (["render", "-o", "OUT", "--env", "MISSING.exr"], "MISSING.exr does not exist"),
        (["render", "-o", "OUT", "--samples", "9"], "--samples is 9"),
        (["render", "-o", "OUT", "--crease", "0"], "--crease is 0"),
        (["render", "-o", "OUT", "--as", "height"], "needs an input file"),
        (["render", "IMAGE.png", "-o", "OUT"], "accepted with --as height or --as normals"),
        (["render", "IMAGE.png", "--as", "height", "--size", "9x9", "-o", "OUT"], "an image keeps its own size"),
        (["sculpt"], "invalid choice"),
    ],
)
def test_wrong_input_is_one_plain_line_and_exit_code_2(arguments, words, tmp_path, capsys):
    (tmp_path / "EMPTY.obj").write_text("# nothing\n")
    (tmp_path / "BROKEN.ply").write_text("hello\n")
    named = [str(tmp_path / a) if a.split("/")[0].split(".")[0].isupper() and a.isascii() else a for a in arguments]
    named = [a + ".png" if a.endswith("OUT") else a for a in named]
    named = [str(tmp_path / a) if a == "o.xyz" else a for a in named]
    assert main(named) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("shapeenh: error: ")
    assert words in captured.err
    assert captured.out == ""
