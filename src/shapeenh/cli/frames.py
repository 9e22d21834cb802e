"""Frames of a moving picture: read from images or a video, written one by one so that a run can be taken up again.

A frame is written under a temporary name and then renamed: what has a frame's name is a whole frame. Frames that are
there and not older than their source are kept. A record beside them says with which options they were drawn.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import math
import os
import re
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from shapeenh import codecs, io
from shapeenh.cli import values
from shapeenh.cli.terminal import one_line
from shapeenh.cli.values import UsageError

STILL_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".hdr")
MOVING_SUFFIXES = (".gif", ".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
READERS = ("av", "imageio_ffmpeg")
RECORD = ".shapeenh.json"
PARTIAL = ".part"

# ------------------------------------------------------------------------------------------- sources


@dataclass(frozen=True)
class Frame:
    """One picture of a sequence; `read()` gives [h, w, 3] in [0, 1], sRGB-encoded as it is seen."""

    name: str
    modified: float
    read: Callable[[], np.ndarray]


@dataclass(frozen=True)
class Source:
    """A sequence: how many frames, if that is known; how fast, if it says so; what it was made from."""

    frames: Iterator[Frame]
    count: int | None
    fps: float | None
    origin: list[str]


def is_frames(inputs: list[str]) -> bool:
    """True for what holds pictures and no geometry: images, a folder, a pattern, a video."""
    if len(inputs) > 1:
        return True
    if not inputs:
        return False
    path = Path(inputs[0])
    return path.is_dir() or path.suffix.lower() in STILL_SUFFIXES + MOVING_SUFFIXES or _is_pattern(inputs[0])


def open_source(inputs: list[str]) -> Source:
    """Images by name, folder or pattern, in the order of the numbers in their names; or one GIF or video."""
    if len(inputs) == 1 and Path(inputs[0]).suffix.lower() in MOVING_SUFFIXES and not _is_pattern(inputs[0]):
        return _moving(Path(inputs[0]))
    paths = _images(inputs)
    stems = [p.stem for p in paths]
    double = {s for s in stems if stems.count(s) > 1} if len(set(stems)) < len(stems) else ()
    if double:
        raise UsageError(f"two input images are called {sorted(double)[0]!r}; accepted are names that differ")
    frames = (Frame(p.stem, p.stat().st_mtime, partial(_load, p)) for p in paths)
    return Source(frames, len(paths), None, [p.name for p in paths])


def _is_pattern(text: str) -> bool:
    return any(c in text for c in "*?[") and not Path(text).exists()


def _images(inputs: list[str]) -> list[Path]:
    paths: list[Path] = []
    for text in inputs:
        path = Path(text)
        if path.is_dir():
            found = [p for p in path.iterdir() if p.suffix.lower() in STILL_SUFFIXES and not p.name.startswith(".")]
            what = f"the folder {path} holds no image; accepted are {', '.join(STILL_SUFFIXES)}"
        elif _is_pattern(text):
            found = [p for p in path.parent.glob(path.name) if p.suffix.lower() in STILL_SUFFIXES]
            what = f"no image matches {text!r}; accepted are {', '.join(STILL_SUFFIXES)}"
        elif path.exists() and path.suffix.lower() not in STILL_SUFFIXES:
            raise UsageError(f"{path} is no image; accepted among several inputs are {', '.join(STILL_SUFFIXES)}")
        else:
            if not path.exists():
                raise UsageError(f"{path} does not exist")
            found, what = [path], ""
        if not found:
            raise UsageError(what)
        paths += sorted(found, key=lambda p: [int(t) if t.isdigit() else t for t in re.split(r"(\d+)", p.name)])
    return paths


def _moving(path: Path) -> Source:
    import imageio.v3 as iio

    if not path.is_file():
        raise UsageError(f"{path} does not exist")
    _need_video_plugin(path)
    plugin: dict[str, Any] = {"plugin": "pillow"} if path.suffix.lower() == ".gif" else {}
    options = plugin | {"mode": "RGB"} if plugin else {}
    try:
        facts, properties = iio.immeta(path, **plugin), iio.improps(path, **plugin)
        count = properties.n_images
        count = int(count) if count is not None and np.isfinite(count) and count > 0 else None
        fps = facts.get("fps") or (1e3 / facts["duration"] if facts.get("duration") and options else None)
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise UsageError(f"{path} cannot be read as a video: {one_line(error)[:200]}") from None
    if count is None and facts.get("fps") and facts.get("duration"):
        count = math.floor(facts["fps"] * facts["duration"] + 0.5)
    modified = path.stat().st_mtime

    def frames():
        pictures = iio.imiter(path, **options)
        for k in range(sys.maxsize):
            try:
                picture = next(pictures)
            except StopIteration:
                return
            except (OSError, ValueError, RuntimeError) as error:
                raise UsageError(f"{path} cannot be read from frame {k} on: {one_line(error)[:200]}") from None
            yield Frame(f"frame_{k:05d}", modified, partial(_displayed, picture))

    return Source(frames(), count, fps, [path.name])


def _need_video_plugin(path: Path) -> None:
    if path.suffix.lower() != ".gif" and not any(importlib.util.find_spec(name) for name in READERS):
        raise UsageError(
            f"{path} is a video, and none of imageio's video plugins is installed; "
            "pip install 'shapeenh[video]', or use a GIF or a folder of images"
        )


def _load(path: Path) -> np.ndarray:
    return _displayed(io.load_image(path))


def _displayed(image) -> np.ndarray:
    """[h, w, 3] in [0, 1] as displayed; transparency over white, linear formats encoded."""
    image = np.asarray(image)
    if np.issubdtype(image.dtype, np.integer):
        image = image / np.float32(np.iinfo(image.dtype).max)
    else:
        image = codecs.srgb_encode(np.clip(np.nan_to_num(image), 0, 1))
    if image.ndim == 2:
        image = image[..., None]
    alpha = image[..., -1:] if image.shape[-1] in (2, 4) else 1
    rgb = image[..., :3] if image.shape[-1] >= 3 else np.repeat(image[..., :1], 3, axis=-1)
    return np.asarray(rgb * alpha + (1 - alpha), np.float32)


# ------------------------------------------------------------------------------------------- where they go


class Sink:
    """A folder of PNG; or a GIF or video by way of the folder `.OUT.frames`, which is gone when it is complete."""

    def __init__(self, output: str, options: dict, *, overwrite: bool):
        self.output = Path(output)
        self.moving = self.output.suffix.lower() in MOVING_SUFFIXES
        if self.moving:
            values.check_folder(self.output.parent, "output folder")
            _need_video_plugin(self.output)
            self.folder = self.output.with_name(f".{self.output.name}.frames")
        elif self.output.suffix.lower() in STILL_SUFFIXES:
            moving = ", ".join(MOVING_SUFFIXES)
            raise UsageError(f"{output} is one picture; accepted for several frames are a folder and {moving}")
        else:
            values.check_folder(self.output.parent, "parent of the output folder")
            self.folder = self.output
        self.names: list[str] = []
        self._claim(options, overwrite)

    def _claim(self, options: dict, overwrite: bool) -> None:
        """Make the folder ours: no frames of other options or of somebody else are mixed in or replaced."""
        if self.folder.exists() and not self.folder.is_dir():
            raise UsageError(f"{self.folder} is not a folder")
        self.folder.mkdir(exist_ok=True)
        for leftover in self.folder.glob(f".*{PARTIAL}"):
            leftover.unlink()
        record = self.folder / RECORD
        found = None
        if record.exists():
            with contextlib.suppress(OSError, ValueError):
                found = json.loads(record.read_text())
        if found == options:
            return
        present = [p.name for p in self.folder.iterdir() if p.suffix == ".png"]
        if present and not overwrite:
            whose = "drawn with other options" if found is not None else "that shapeenh did not draw"
            raise UsageError(f"{self.folder} holds pictures {whose}; accepted are another folder and --overwrite")
        if found is not None:  # ours, but of other options
            for name in present:
                (self.folder / name).unlink()
        self._replace(record, json.dumps(options, indent=1).encode())

    def has(self, frame: Frame) -> bool:
        """A whole frame is there, and it is not older than what it was drawn from."""
        path = self.folder / f"{frame.name}.png"
        return path.exists() and path.stat().st_mtime >= frame.modified

    def keep(self, frame: Frame) -> None:
        self.names.append(frame.name)

    def write(self, frame: Frame, image) -> None:
        self._replace(self.folder / f"{frame.name}.png", codecs.encode_image(np.asarray(image), ".png", bits=8))
        self.keep(frame)

    def finish(self, fps: float) -> None:
        """Put the frames together, where one file is wanted."""
        if not self.moving:
            return
        partial = self.output.with_name(f".{self.output.stem}{PARTIAL}{self.output.suffix}")
        pictures = (io.load_image(self.folder / f"{name}.png")[..., :3] for name in self.names)
        try:
            _encode(partial, pictures, fps)
            os.replace(partial, self.output)
        finally:
            partial.unlink(missing_ok=True)
        for path in (*self.folder.glob("*.png"), self.folder / RECORD):
            path.unlink()
        self.folder.rmdir()

    @staticmethod
    def _replace(path: Path, data: bytes) -> None:
        partial = path.with_name(f".{path.name}{PARTIAL}")
        try:
            partial.write_bytes(data)
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)


def _encode(path: Path, pictures: Iterator[np.ndarray], fps: float) -> None:
    if path.suffix.lower() == ".gif":
        from PIL import Image  # imageio's own reader of GIF; imageio would hold all frames in memory

        images = (Image.fromarray(picture) for picture in pictures)
        first = next(images)
        first.save(path, save_all=True, append_images=images, duration=round(1e3 / fps), loop=0)
        return
    import imageio.v2 as iio

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="os.fork")  # the plugin starts ffmpeg, which is all it forks for
        writer = iio.get_writer(path, fps=fps, macro_block_size=2)
    with writer:
        for picture in pictures:
            writer.append_data(picture)


# ------------------------------------------------------------------------------------------- the loop


def run(source: Source, sink: Sink, draw: Callable[[np.ndarray], np.ndarray], *, fps: float | None) -> tuple[int, int]:
    """Draw every frame that is not there yet; returns how many were drawn and how many kept."""
    shape, first, drawn, kept = None, "", 0, 0
    start = time.perf_counter()
    for k, frame in enumerate(source.frames):
        if sink.has(frame):
            sink.keep(frame)
            kept += 1
            continue
        picture = frame.read()
        if shape is None:
            shape, first = picture.shape, frame.name
        elif picture.shape != shape:
            size, expected = (f"{s[1]}x{s[0]}" for s in (picture.shape, shape))
            raise UsageError(f"{frame.name} is {size} and {first} {expected}; accepted are frames of one size")
        sink.write(frame, draw(picture))
        drawn += 1
        _progress(k + 1, source.count, drawn, time.perf_counter() - start)
    if drawn + kept == 0:
        raise UsageError(f"{', '.join(source.origin)} holds no frames")
    if drawn and sys.stderr.isatty():
        print(file=sys.stderr)
    sink.finish(fps or source.fps or 12.0)
    return drawn, kept


def _progress(number: int, count: int | None, drawn: int, seconds: float) -> None:
    if not sys.stderr.isatty():
        return
    left = "" if count is None else f" of {count}, {max(count - number, 0) * seconds / drawn:.0f} s left"
    print(
        f"\rshapeenh: frame {number}{left}, {drawn / seconds:.1f} per second    ", end="", file=sys.stderr, flush=True
    )
