"""Lines, stage by stage: `python -m benchmarks.lines [MESH ...] [--size WxH] [--kind KIND]`.

Warm medians, compile apart; then the same from farther and farther away, where fewer pixels are near lines, in an image
of the same size; then an object of always as many pixels in larger and larger images; then straight lines, more and
more of them, with footprints of several sizes. TH10 8.4 reports 56 frames per second (18 ms) for one kind of line at
1024 x 768 with a footprint of 10 px and 10 diffusion steps, on its GPU (82 without diffusion). Ten steps of 1/5 are
sigma = 2 here.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import shapeenh as se
from benchmarks import harness

THESIS_MS = 1000 / 56
BYTES = 4 * (4 + 3 + 4) + 1  # of a LineField, a Profile and a picture in float32
SIGMA = 2.0
DIRECTION = np.array([0.34, 0.26, 0.90])


def stages(mesh, kind: str, *, width: int, height: int, away: float = 1.0) -> tuple[dict, dict]:
    """The calls that make the lines of one frame, each on the finished results of those before it.

    away: how many times as far from the mesh as where it fills the image.
    """
    camera = se.frame_mesh(mesh, direction=DIRECTION, aspect=width / height)
    if away > 1:
        low, high = np.asarray(mesh.vertices.min(axis=0)), np.asarray(mesh.vertices.max(axis=0))
        eye = 0.5 * (low + high) + 1.8 * away * np.linalg.norm(high - low) * DIRECTION / np.linalg.norm(DIRECTION)
        camera = se.perspective_camera(eye, 0.5 * (low + high), fov_degrees=30.0, aspect=width / height)
    gbuffer = se.render_gbuffer(mesh, camera, height=height, width=width)
    descriptor = se.describe(gbuffer)
    style = se.style_brush("ink", kind, height=height)
    least = float(style.low)
    brush = se.Brush(radius=5.0, low=style.low, high=style.high)
    field = se.line_field(kind, gbuffer, descriptor, sigma=SIGMA)
    profile = se.fit_profile(field, least=least)

    def frame():
        field = se.line_field(kind, gbuffer, descriptor, sigma=SIGMA)
        return se.draw_lines(se.fit_profile(field, least=least), field, brush)

    sheets = {"gbuffer": gbuffer, "descriptor": descriptor}
    calls = {
        "field, 10 diffusion steps": lambda: se.line_field(kind, gbuffer, descriptor, sigma=SIGMA).height,
        "fit": lambda: se.fit_profile(field, least=least).distance,
        "draw, footprint 10 px": lambda: se.draw_lines(profile, field, brush),
        "draw, ending at silhouettes": lambda: se.draw_lines(profile, field, brush, **sheets),
        "lines: field, fit, draw": frame,
    }
    return calls, {"covered": int(gbuffer.mask.sum()), "near lines": int(np.asarray(profile.valid).sum())}


def distances(mesh, kind: str, *, width: int, height: int) -> list[dict]:
    """The stages with fewer and fewer pixels near lines, in one image size: what is left is what all pixels cost."""
    calls, facts = {}, {}
    for away in (1, 2, 4, 8):
        own, facts[away] = stages(mesh, kind, width=width, height=height, away=away)
        calls |= {(away, stage): call for stage, call in own.items()}
    times = harness.measure(calls, repeats=7, seconds=40)
    return [{"distance": away, "stage": stage, **facts[away], **times[away, stage]} for away, stage in calls]


def sizes(mesh, kind: str) -> list[dict]:
    """The stages for as many pixels near lines, in larger and larger images: what the rest of the image costs."""
    calls, facts = {}, {}
    for height in (384, 768, 1152):
        size = f"{height * 4 // 3}x{height}"
        own, facts[size] = stages(mesh, kind, width=height * 4 // 3, height=height, away=height / 192)
        facts[size] |= {"megapixels": round(height * height * 4 / 3e6, 3)}
        calls |= {(size, stage): call for stage, call in own.items()}
    times = harness.measure(calls, repeats=9, seconds=20)
    return [{"size": size, "stage": stage, **facts[size], **times[size, stage]} for size, stage in calls]


def per_megapixel(rows: list[dict]) -> dict[str, float]:
    """Milliseconds that a million more pixels of background cost, stage by stage."""
    found = {}
    for stage in dict.fromkeys(row["stage"] for row in rows):
        first, *_, last = (row for row in rows if row["stage"] == stage)
        more = last["megapixels"] - first["megapixels"]
        found[stage] = round((last["min_ms"] - first["min_ms"]) / more, 2)
    return found


def of_all_pixels(rows: list[dict]) -> dict[str, float]:
    """Milliseconds of each stage that do not follow the pixels near lines: the straight line through the nearest and
    the farthest row, at none of them."""
    found = {}
    for stage in dict.fromkeys(row["stage"] for row in rows):
        first, *_, last = (row for row in rows if row["stage"] == stage)
        slope = (first["min_ms"] - last["min_ms"]) / (first["near lines"] - last["near lines"])
        found[stage] = round(last["min_ms"] - slope * last["near lines"], 2)
    return found


def scaling(*, size: int = 768) -> list[dict]:
    """How the cost grows with the pixels near lines, and with the footprint: straight lines in one image."""
    row = np.mgrid[0:size, 0:size][0].astype(np.float32)
    rows = []
    for spacing in (256, 64, 32):
        height = np.exp(-0.5 * ((row % spacing - spacing / 2 + 0.3) / 2) ** 2).astype(np.float32)
        theta = np.broadcast_to(np.float32([0, 1]), (size, size, 2))
        field = se.make_line_field(height, theta)
        profile = se.fit_profile(field, least=0.1)
        calls = {"fit": lambda field=field: se.fit_profile(field, least=0.1).distance}
        for radius in (2.0, 4.0, 8.0):
            brush = se.Brush(radius=radius)
            calls[f"draw, radius {radius:g}"] = lambda p=profile, f=field, b=brush: se.draw_lines(p, f, b)
        near = int(np.asarray(profile.valid).sum())
        for stage, times in harness.measure(calls, repeats=5).items():
            rows.append({"mesh": f"stripes every {spacing} px", "stage": stage, "near lines": near, **times})
    return rows


def growth(rows: list[dict]) -> dict[str, float]:
    """Exponents p of cost ~ x^p between the first and the last x: of the pixels near lines, and of the radius."""

    def exponent(first, last, x):
        return round(float(np.log(last["min_ms"] / first["min_ms"]) / np.log(x)), 2)

    at = {(r["mesh"], r["stage"]): r for r in rows}
    few, many = (f"stripes every {n} px" for n in (256, 32))
    stages = ("fit", "draw, radius 2", "draw, radius 4", "draw, radius 8")
    found = {s: exponent(at[few, s], at[many, s], at[many, s]["near lines"] / at[few, s]["near lines"]) for s in stages}
    return found | {"radius 2 to 8": exponent(at[many, "draw, radius 2"], at[many, "draw, radius 8"], 4)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meshes", nargs="*", type=Path)
    parser.add_argument("--size", default="1024x768")
    parser.add_argument("--kind", default="valley")
    arguments = parser.parse_args()
    width, height = (int(n) for n in arguments.size.split("x"))
    meshes = harness.meshes(arguments.meshes, ("armadillo",))
    rows = []
    for name, mesh in meshes.items():
        calls, facts = stages(mesh, arguments.kind, width=width, height=height)
        for stage, times in harness.measure(calls, repeats=9).items():
            rows.append({"mesh": name, "stage": stage, **facts, **times})
    print(harness.table(rows))
    far = distances(next(iter(meshes.values())), arguments.kind, width=width, height=height)
    print(harness.table(far))
    print("ms that do not follow the pixels near lines:", of_all_pixels(far))
    large = sizes(next(iter(meshes.values())), arguments.kind)
    print(harness.table(large))
    print("ms per megapixel of background:", per_megapixel(large))
    stripes = scaling()
    print(harness.table(stripes))
    print("growth of the cost with the pixels near lines (1 is linear) and with the radius:", growth(stripes))
    print(f"TH10 8.4, its GPU: {THESIS_MS:.1f} ms per frame")
    facts = {"size": arguments.size, "kind": arguments.kind, "thesis_ms": THESIS_MS, "growth": growth(stripes)}
    facts |= {"of_all_pixels_ms": of_all_pixels(far), "distances": far}
    facts |= {"per_megapixel_ms": per_megapixel(large), "sizes": large}
    whole = "lines: field, fit, draw"
    took = next(row["median_ms"] for row in rows if row["stage"] == whole)
    said = (
        f"One kind takes {took:.0f} ms where TH10's GPU took {THESIS_MS:.0f}; of that "
        f"{of_all_pixels(far)[whole]:.0f} ms do not follow the pixels near lines. A million more pixels of background "
        f"cost {per_megapixel(large)[whole]:.1f} ms: {BYTES} bytes each of field, profile and picture to be written."
    )
    print(harness.write("lines", [*rows, *stripes], **facts, answer=said))
    print(said)


if __name__ == "__main__":
    main()
