"""What memory pages cost: `python -m benchmarks.pages [MESH]`.

Every call writes its results into memory that the C library has just got from the system, page by page. glibc 2.35 or
newer on Linux asks for large pages where the environment variable GLIBC_TUNABLES says so before Python starts: no
number of a picture changes. Each setting is timed in a process of its own, in turns.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import shapeenh as se
from benchmarks import frame, harness

SETTING = "glibc.malloc.hugetlb=1"


def calls(mesh) -> dict:
    """What is timed: a frame, its gradient, and G-buffers whose time is mostly writing."""
    found, _ = frame.stages(mesh, se.procedural_studio(), width=800, height=600, count=54)
    some = {name: found[name] for name in ("frame", "frame, value and gradient")}
    for width, height in ((1920, 1080), (3840, 2160)):
        camera = se.frame_mesh(mesh, aspect=width / height)
        some[f"G-buffer, {width} x {height}"] = lambda c=camera, w=width, h=height: se.render_gbuffer(
            mesh, c, height=h, width=w
        )
    return some


def timed_apart(arguments: list[str], setting: str, cache: str) -> dict[str, float]:
    """Median milliseconds per call, in a process with that setting; what the first compiled, the others find."""
    command = [sys.executable, "-m", "benchmarks.pages", "--inner", *arguments]
    environment = os.environ | {"GLIBC_TUNABLES": setting, "JAX_COMPILATION_CACHE_DIR": cache}
    done = subprocess.run(command, env=environment, capture_output=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mesh", nargs="?", type=Path)
    parser.add_argument("--inner", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.inner:
        mesh = next(iter(harness.meshes([arguments.mesh] if arguments.mesh else [], ("armadillo",)).values()))
        print(json.dumps({key: t["median_ms"] for key, t in harness.measure(calls(mesh), seconds=5).items()}))
        return
    given = [str(arguments.mesh)] if arguments.mesh else []
    runs: dict[str, list[dict]] = {"": [], SETTING: []}
    with tempfile.TemporaryDirectory() as cache:
        for _ in range(1 if harness.QUICK else 3):
            for setting, found in runs.items():
                found.append(timed_apart(given, setting, cache))
    rows = []
    for call in runs[""][0]:
        plain, large = (statistics.median(run[call] for run in found) for found in runs.values())
        rows.append({"call": call, "ms": plain, "ms with large pages": large, "ratio": round(large / plain, 2)})
    print(harness.table(rows))
    of = {row["call"]: row["ratio"] for row in rows}
    said = (
        f"GLIBC_TUNABLES={SETTING}, set before Python starts, brings a frame to {of['frame']:g} of its time, one with "
        f"its gradient to {of['frame, value and gradient']:g}, a G-buffer of 3840 x 2160 to "
        f"{of['G-buffer, 3840 x 2160']:g}; the price is memory that is handed out in pieces of 2 MiB."
    )
    print(harness.write("pages", rows, glibc=platform.libc_ver()[1], answer=said))
    print(said)


if __name__ == "__main__":
    main()
