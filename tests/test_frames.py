"""`shapeenh lines`: objects, and moving pictures frame by frame, with interruption, resumption and wrong input."""

import json
import os

import imageio.v3 as iio
import numpy as np
import pytest

import shapeenh as se
from shapeenh.cli import frames, lines, main

H, W = 24, 32
LINES = ["--kinds", "luminance", "--detail", "10"]


def moving_edge(k):
    """A bright half plane whose border moves one pixel per frame."""
    x = np.arange(W) - (8.0 + k)
    return np.uint8(np.round(np.broadcast_to(128 + 100 * np.tanh(x), (H, W))))


@pytest.fixture
def clip(tmp_path):
    """Eleven frames: f2 comes before f10."""
    folder = tmp_path / "clip"
    folder.mkdir()
    for k in range(11):
        se.save_image(folder / f"f{k}.png", moving_edge(k))
    return folder


def ink(picture):
    return 255 - np.asarray(picture, float)[..., :3].mean(-1)


def test_every_frame_shows_the_edge_where_it_is(clip, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["lines", str(clip), "-o", str(out), *LINES]) == 0
    assert sorted(p.name for p in out.iterdir()) == sorted([*(f"f{k}.png" for k in range(11)), frames.RECORD])
    for k in (0, 5, 10):
        drawn = ink(se.load_image(out / f"f{k}.png"))[5:-5]
        assert drawn.shape == (H - 10, W)
        assert np.all(np.abs(np.argmax(drawn, axis=1) - (8 + k)) <= 1)
        assert np.max(drawn[:, np.abs(np.arange(W) - 8 - k) > 5]) < 40
    assert capsys.readouterr() == ("", "")  # not a terminal: silent


def test_an_interrupted_run_goes_on_where_it_stopped(clip, tmp_path, monkeypatch, capsys):
    out, whole = tmp_path / "out", tmp_path / "whole"
    assert main(["lines", str(clip), "-o", str(whole), *LINES]) == 0
    draw, calls = lines.frame_lines, []

    def interrupted(picture, arguments):
        calls.append(1)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return draw(picture, arguments)

    monkeypatch.setattr(lines, "frame_lines", interrupted)
    assert main(["lines", str(clip), "-o", str(out), *LINES]) == 130
    # in the order of their numbers, and none of them half written
    assert sorted(p.name for p in out.iterdir()) == [frames.RECORD, "f0.png", "f1.png", "f2.png"]
    before = {p.name: p.stat().st_mtime_ns for p in out.iterdir()}
    calls.clear()
    calls.extend([0] * 10)
    assert main(["lines", str(clip), "-o", str(out), *LINES]) == 0
    assert len(calls) == 10 + 8
    assert "8 frames drawn, 3 kept" in capsys.readouterr().out
    assert all((out / name).stat().st_mtime_ns == time for name, time in before.items())
    for k in range(11):
        assert (out / f"f{k}.png").read_bytes() == (whole / f"f{k}.png").read_bytes()


@pytest.mark.parametrize("place", ["write", "rename"])
def test_a_frame_interrupted_while_it_is_written_leaves_nothing(place, clip, tmp_path, monkeypatch):
    out = tmp_path / "out"
    assert main(["lines", str(clip / "f0.png"), str(clip / "f1.png"), "-o", str(out), *LINES]) == 0
    (out / "f1.png").unlink()
    if place == "write":

        def half(path, data):
            with path.open("wb") as file:
                file.write(data[: len(data) // 2])
            raise KeyboardInterrupt

        monkeypatch.setattr(frames.Path, "write_bytes", half)
    else:
        monkeypatch.setattr(frames.os, "replace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    arguments = ["lines", str(clip / "f0.png"), str(clip / "f1.png"), "-o", str(out), *LINES]
    assert main(arguments) == 130
    assert sorted(p.name for p in out.iterdir()) == [frames.RECORD, "f0.png"]
    monkeypatch.undo()
    (out / f".f1.png{frames.PARTIAL}").write_bytes(b"killed without a chance to clean up")
    assert main(arguments) == 0
    assert sorted(p.name for p in out.iterdir()) == [frames.RECORD, "f0.png", "f1.png"]


def test_frames_newer_than_what_was_drawn_are_drawn_again(clip, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["lines", str(clip / "f*.png"), "-o", str(out), *LINES]
    assert main(arguments) == 0
    later = (out / "f3.png").stat().st_mtime + 10
    os.utime(clip / "f3.png", (later, later))
    capsys.readouterr()
    assert main(arguments) == 0
    assert "1 frames drawn, 10 kept" in capsys.readouterr().out


def test_all_frames_share_one_compiled_function(clip, tmp_path, compilations):
    first, rest = str(clip / "f0.png"), [str(clip / f"f{k}.png") for k in range(1, 6)]
    assert main(["lines", first, "-o", str(tmp_path / "one.png"), *LINES]) == 0
    compilations.clear()
    assert main(["lines", *rest, "-o", str(tmp_path / "out"), *LINES]) == 0
    assert compilations == []


def test_gif_to_gif_and_its_resumption(clip, tmp_path, monkeypatch):
    moving = np.stack([np.repeat(moving_edge(k)[..., None], 3, -1) for k in range(5)])
    iio.imwrite(tmp_path / "in.gif", moving, duration=50, loop=0)
    out, hidden = tmp_path / "out.gif", tmp_path / ".out.gif.frames"
    arguments = ["lines", str(tmp_path / "in.gif"), "-o", str(out), *LINES, "--color", "#204080"]
    encode = frames._encode

    def fails(path, pictures, fps):
        next(pictures)
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(frames, "_encode", fails)
    assert main(arguments) == 130
    assert not out.exists()
    assert len(list(hidden.glob("*.png"))) == 5
    monkeypatch.setattr(frames, "_encode", encode)
    monkeypatch.setattr(lines, "frame_lines", None)  # all frames are there: nothing is drawn
    assert main(arguments) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["clip", "in.gif", "out.gif"]
    drawn = iio.imread(out, mode="RGB")
    assert drawn.shape == (5, H, W, 3)
    assert iio.immeta(out)["duration"] == 50  # the speed of the input
    assert np.argmax(ink(drawn[4])[H // 2]) - np.argmax(ink(drawn[0])[H // 2]) == 4
    blue = drawn[2, H // 2, np.argmax(ink(drawn[2])[H // 2])].astype(int)
    assert blue[2] > blue[0] + 20


def test_transparent_frames_and_those_over_the_picture(clip, tmp_path):
    first = str(clip / "f0.png")
    assert main(["lines", first, "-o", str(tmp_path / "t.png"), "--over", "transparent", *LINES]) == 0
    clear = se.load_image(tmp_path / "t.png")
    assert clear.shape == (H, W, 4)
    assert clear[H // 2, 8, 3] > 100
    assert not np.any(clear[:, 20:, 3])
    assert main(["lines", first, "-o", str(tmp_path / "s.png"), "--over", "shading", *LINES]) == 0
    over = se.load_image(tmp_path / "s.png").astype(int)
    away = np.s_[:, 20:]
    assert np.max(np.abs(over[..., 0][away] - moving_edge(0).astype(int)[away])) <= 1
    assert np.min(over[H // 2, 6:11, 0] - moving_edge(0).astype(int)[H // 2, 6:11]) < -40


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["CLIP", "-o", "OUT"], "accepted with --kinds luminance"),
        (["CLIP", "-o", "OUT", "--kinds", "luminance,ridge"], "accepted with --kinds luminance"),
        (["CLIP", "-o", "OUT", "--kinds", "luminance", "--size", "9x9"], "frames keep their own size"),
        (["CLIP", "-o", "OUT.png", *LINES], "is one picture"),
        (["CLIP", "-o", "NOWHERE/out", *LINES], "does not exist"),
        (["CLIP", "-o", "OUT.gif", "--over", "transparent", *LINES], "keeps no transparency"),
        (["CLIP", "-o", "CLIP", *LINES], "that shapeenh did not draw"),
        (["CLIP", "-o", "OUT", "--fps", "0", *LINES], "--fps is 0"),
        (["CLIP", "-o", "OUT", *LINES, "--detail", "0"], "--detail is 0"),
        (["CLIP/x*.png", "-o", "OUT", *LINES], "no image matches"),
        (["EMPTY", "-o", "OUT", *LINES], "holds no image"),
        (["MISSING.gif", "-o", "OUT", *LINES], "does not exist"),
        (["BROKEN.gif", "-o", "OUT", *LINES], "cannot be read as a video"),
        (["BROKEN.mp4", "-o", "OUT", *LINES], "pip install 'shapeenh[video]'"),
        (["CLIP", "-o", "OUT.mp4", *LINES], "pip install 'shapeenh[video]'"),
        (["CLIP/f0.png", "ODD.png", "-o", "OUT", *LINES], "accepted are frames of one size"),
        (["CLIP/f0.png", "CLIP/f0.png", "-o", "OUT", *LINES], "are called 'f0'"),
        (["CLIP/f0.png", "MISSING.png", "-o", "OUT", *LINES], "does not exist"),
    ],
)
def test_wrong_input_is_one_plain_line(arguments, words, clip, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(frames, "READERS", ("no_such_plugin",))
    for name in ("BROKEN.gif", "BROKEN.mp4"):
        (tmp_path / name).write_bytes(b"no moving picture")
    (tmp_path / "EMPTY").mkdir()
    se.save_image(tmp_path / "ODD.png", np.zeros((5, 5), np.uint8))
    places = {"CLIP": str(clip)} | {
        n: str(tmp_path / n) for n in ("OUT", "EMPTY", "MISSING", "BROKEN", "ODD", "NOWHERE")
    }
    for name, place in places.items():
        arguments = [place + a[len(name) :] if a.startswith(name) else a for a in arguments]
    assert main(["lines", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert words in captured.err
    assert captured.out == ""


def test_frames_of_other_options_are_not_mixed(clip, tmp_path, capsys):
    out = tmp_path / "out"
    one = ["lines", str(clip / "f0.png"), str(clip / "f1.png"), "-o", str(out), *LINES]
    assert main(one) == 0
    plain = (out / "f0.png").read_bytes()
    assert main([*one, "--color", "grey"]) == 2
    assert "drawn with other options" in capsys.readouterr().err
    assert (out / "f0.png").read_bytes() == plain
    assert main([*one, "--color", "grey", "--overwrite"]) == 0
    assert (out / "f0.png").read_bytes() != plain
    assert json.loads((out / frames.RECORD).read_text())["input"] == ["f0.png", "f1.png"]


# ------------------------------------------------------------------------------------------- objects

SMALL = ["--size", "64x48", "--lights", "8", "--samples", "1"]


@pytest.mark.slow
def test_lines_of_an_object_over_paper_shading_and_nothing(tmp_path):
    pictures = {}
    for over in lines.OVER:
        path = tmp_path / f"{over}.png"
        assert main(["lines", "-o", str(path), "--over", over, *SMALL]) == 0
        pictures[over] = se.load_image(path).astype(int)
    assert pictures["transparent"].shape == (48, 64, 4)
    strokes = pictures["transparent"][..., 3] > 200
    assert 0.01 < strokes.mean() < 0.5
    for over in ("paper", "shading"):
        assert pictures[over].shape == (48, 64, 3)
        assert np.all(pictures[over][strokes] < 140)
    clear = pictures["transparent"][..., 3] == 0
    assert np.all(np.ptp(pictures["paper"][clear], axis=0) <= 1)
    assert np.all(pictures["paper"][clear] > 230)
    assert pictures["shading"][clear].std() > 15


def test_height_fields_have_lines_too(tmp_path):
    x = np.mgrid[:36, :48][1]
    se.save_image(tmp_path / "relief.tif", np.float32(3 * np.sin(x / 4)))
    out = tmp_path / "o.png"
    relief = ["lines", str(tmp_path / "relief.tif"), "--as", "height", "--lights", "8", "-o", str(out)]
    assert main([*relief, "--kinds", "valley", "--detail", "10"]) == 0
    drawn = ink(se.load_image(out))[8:-8].mean(axis=0)
    assert max(drawn[c] for c in (6, 31)) < 20  # maxima of the sine
    assert drawn[19] > 100  # its minimum
