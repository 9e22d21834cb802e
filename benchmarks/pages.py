"""What settings of the process save: `python -m benchmarks.pages [MESH]`.

Every call writes its results into memory that the C library has just got from the system, page by page, each filled
with zeros at its first touch. `keep_memory` makes it keep what is freed. And glibc 2.35 or newer on Linux asks for
large pages where the environment variable GLIBC_TUNABLES says so before Python starts. No number of a picture changes.
On processors with AVX-512, XLA uses registers of 512 bits instead of 256 where XLA_FLAGS says so; some operations are
rounded otherwise then. Sums over lights that are compiled on their own ask for them anyway. Each setting is timed in a
process of its own, in turns. Of the other benchmarks, `benchmarks.gradients` and `benchmarks.diffusion` keep memory.
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
from benchmarks import frame, gradients, harness

LARGE = {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}
WIDE = {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_prefer_vector_width=512"}
SETTINGS: dict[str, tuple[list[str], dict[str, str]]] = {  # options and environment of the process
    "fresh": ([], {}),
    "large pages": ([], LARGE),
    "kept": (["--keep"], {}),
    "kept, large": (["--keep"], LARGE),
    "kept, wide": (["--keep"], WIDE),
}
GRADIENTS = (
    "describe",
    "line_field",
)  # the stages with the largest share of memory, in all that they have derivatives in


def calls(mesh) -> dict:
    """What is timed: a frame, gradients, and G-buffers whose time is mostly writing."""
    found, _ = frame.stages(mesh, se.procedural_studio(), width=800, height=600, count=54)
    some = {name: found[name] for name in ("frame", "frame, value and gradient")}
    scene, stages = gradients.stages(mesh, width=800, height=600, count=54)
    for stage, _, function, given in stages:
        if stage in GRADIENTS:  # the last of a name: the one in most arguments
            _, both = gradients.compiled(function)
            some[f"{stage}, value and gradient"] = lambda f=both, g=given: f(scene, g)
    for width, height in ((1920, 1080), (3840, 2160)):
        camera = se.frame_mesh(mesh, aspect=width / height)
        some[f"G-buffer, {width} x {height}"] = lambda c=camera, w=width, h=height: se.render_gbuffer(
            mesh, c, height=h, width=w
        )
    return some


def timed_apart(arguments: list[str], options: list[str], variables: dict[str, str], cache: str) -> dict[str, float]:
    """Median milliseconds per call, in a process with that setting; what the first compiled, the others find."""
    command = [sys.executable, "-m", "benchmarks.pages", "--inner", *options, *arguments]
    environment = os.environ | variables | {"JAX_COMPILATION_CACHE_DIR": cache}
    done = subprocess.run(command, env=environment, capture_output=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mesh", nargs="?", type=Path)
    parser.add_argument("--inner", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--keep", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.inner:
        if arguments.keep:
            se.keep_memory()
        mesh = next(iter(harness.meshes([arguments.mesh] if arguments.mesh else [], ("armadillo",)).values()))
        print(json.dumps({key: t["median_ms"] for key, t in harness.measure(calls(mesh), seconds=8).items()}))
        return
    given = [str(arguments.mesh)] if arguments.mesh else []
    runs: dict[str, list[dict]] = {name: [] for name in SETTINGS}
    with tempfile.TemporaryDirectory() as cache:
        for _ in range(1 if harness.QUICK else 3):
            for name, setting in SETTINGS.items():
                runs[name].append(timed_apart(given, *setting, cache))
    rows = []
    for call in runs["fresh"][0]:
        ms = {name: statistics.median(run[call] for run in found) for name, found in runs.items()}
        ratios = {"ratio": ms["kept"] / ms["fresh"], "wide_ratio": ms["kept, wide"] / ms["kept"]}
        rows.append({"call": call, **ms, **{name: round(ratio, 2) for name, ratio in ratios.items()}})
    print(harness.table(rows))
    of = {row["call"]: row["ratio"] for row in rows}
    wide = {row["call"]: row["wide_ratio"] for row in rows}
    said = (
        f"keep_memory() brings a frame to {of['frame']:g} of its time, one with its gradient to "
        f"{of['frame, value and gradient']:g}, a gradient of describe to {of['describe, value and gradient']:g}, a "
        f"G-buffer of 3840 x 2160 to {of['G-buffer, 3840 x 2160']:g}; the price is memory that the process holds, and "
        f"compilation at 1.3 times its time. Registers of 512 bits bring the frame to {wide['frame']:g} of that."
    )
    print(harness.write("pages", rows, glibc=platform.libc_ver()[1], answer=said))
    print(said)


if __name__ == "__main__":
    main()
