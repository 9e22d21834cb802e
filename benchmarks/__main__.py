"""All benchmarks, one after the other: `python -m benchmarks [NAME ...] [--quick] [--list]`.

Each writes `results/NAME.json` with the machine, the versions, compile and run apart, and, where its question is one of
time against error, the plot `results/NAME.png` with the default ringed; `results/README.md` has all answers. Real
meshes and maps are used where SHAPEENH_DATA names a folder that has them. Nothing else should run on the machine
meanwhile. `--quick` takes a quarter of an hour instead of a whole one: small images, three runs of each, results in
`results/quick/`.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path

from benchmarks import tables
from benchmarks.harness import RESULTS

NOT_BENCHMARKS = ("__init__", "__main__", "harness", "tables")
QUICK = {  # options of scripts whose work `harness.measure` does not bound
    "batches": ["--size", "160x120", "--count", "2"],
    "coherence": ["--frames", "2", "--height", "100"],
    "descriptor": ["--quick"],
    "diffusion": ["--quick"],
    "fit": ["--size", "48x36", "--starts", "1"],
    "frame": ["--size", "320x240"],
    "gradients": ["--size", "320x240"],
    "inputs": ["--repeats", "1"],
    "line_positions": ["--height", "120"],
    "lines": ["--size", "320x240"],
    "precision": ["--size", "320x240"],
    "raster": ["--sizes", "320x240", "--subdivide", "0", "--cores", "1"],
    "visibility": ["--sizes", "320x240"],
}
WHOLE = {
    "fit": ["--all-solvers"],
    "raster": ["--add"],  # its scenes take an hour: those that are not measured today stay
}


def names() -> list[str]:
    return sorted(p.stem for p in Path(__file__).parent.glob("*.py") if p.stem not in NOT_BENCHMARKS)


def answer(name: str, folder: Path) -> str:
    """The sentence that a benchmark ends in: the default, and what one gives up by going faster."""
    path = folder / f"{name}.json"
    return json.loads(path.read_text()).get("answer", "") if path.exists() else ""


def question(name: str) -> str:
    return importlib.import_module(f"benchmarks.{name}").__doc__.splitlines()[0].split(": `")[0].rstrip(".")


def write_answers(folder: Path) -> Path:
    """`README.md` of the results: every question, its answer, its plot."""
    lines = [
        "# What the benchmarks answer",
        "",
        "Written by `python -m benchmarks`; the numbers are in the JSON files.",
        "",
    ]
    for name in names():
        if (folder / f"{name}.json").exists():
            lines += [f"## {name}", "", f"{question(name)}.", ""]
            lines += [answer(name, folder), ""] if answer(name, folder) else []
            lines += [f"![{name}]({name}.png)", ""] if (folder / f"{name}.png").exists() else []
    path = folder / "README.md"
    path.write_text("\n".join(lines))
    return path


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="which ones (default: all)")
    parser.add_argument("--quick", action="store_true", help="small images and few runs, into results/quick/")
    parser.add_argument("--list", action="store_true", help="only say what there is")
    arguments = parser.parse_args()
    unknown = sorted(set(arguments.names) - set(names()))
    if unknown:
        parser.error(f"unknown: {', '.join(unknown)}; accepted are {', '.join(names())}")
    if arguments.list:
        for name in names():
            print(f"{name:12} {question(name)}")
        return
    failed: list[str] = []
    folder = RESULTS / "quick" if arguments.quick else RESULTS
    environment = os.environ | ({"BENCHMARKS_QUICK": "1"} if arguments.quick else {})
    for name in arguments.names or names():
        print(f"== {name}", flush=True)
        start = time.perf_counter()
        command = [sys.executable, "-m", f"benchmarks.{name}", *(QUICK if arguments.quick else WHOLE).get(name, [])]
        if subprocess.run(command, env=environment).returncode:
            failed.append(name)
        print(f"== {name}: {time.perf_counter() - start:.0f} s. {answer(name, folder)}", flush=True)
    print(write_answers(folder))
    if not arguments.quick:
        tables.main()
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
