"""All benchmarks, one after the other: `python -m benchmarks [NAME ...] [--list]`.

Each writes `results/NAME.json` with the machine, the versions, compile and run apart, and, where its question is one of
time against error, the plot `results/NAME.png` with the default ringed; `results/README.md` has all answers. Real
meshes and maps are used where SHAPEENH_DATA names a folder that has them. Nothing else should run on the machine
meanwhile.
"""

from __future__ import annotations

import argparse
import importlib
import json
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.harness import RESULTS

NOT_BENCHMARKS = ("__init__", "__main__", "harness")


def names() -> list[str]:
    return sorted(p.stem for p in Path(__file__).parent.glob("*.py") if p.stem not in NOT_BENCHMARKS)


def answer(name: str) -> str:
    """The sentence that a benchmark ends in: the default, and what one gives up by going faster."""
    path = RESULTS / f"{name}.json"
    return json.loads(path.read_text()).get("answer", "") if path.exists() else ""


def question(name: str) -> str:
    return importlib.import_module(f"benchmarks.{name}").__doc__.splitlines()[0].split(": `")[0].rstrip(".")


def write_answers() -> Path:
    """`results/README.md`: every question, its answer, its plot."""
    lines = [
        "# What the benchmarks answer",
        "",
        "Written by `python -m benchmarks`; the numbers are in the JSON files.",
        "",
    ]
    for name in names():
        if (RESULTS / f"{name}.json").exists():
            lines += [f"## {name}", "", f"{question(name)}.", ""]
            lines += [answer(name), ""] if answer(name) else []
            lines += [f"![{name}]({name}.png)", ""] if (RESULTS / f"{name}.png").exists() else []
    path = RESULTS / "README.md"
    path.write_text("\n".join(lines))
    return path


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="which ones (default: all)")
    parser.add_argument("--list", action="store_true", help="only say what there is")
    arguments = parser.parse_args()
    unknown = sorted(set(arguments.names) - set(names()))
    if unknown:
        parser.error(f"unknown: {', '.join(unknown)}; accepted are {', '.join(names())}")
    if arguments.list:
        for name in names():
            print(f"{name:12} {question(name)}")
        return
    failed = []
    for name in arguments.names or names():
        print(f"== {name}", flush=True)
        start = time.perf_counter()
        if subprocess.run([sys.executable, "-m", f"benchmarks.{name}"]).returncode:
            failed.append(name)
        print(f"== {name}: {time.perf_counter() - start:.0f} s. {answer(name)}", flush=True)
    print(write_answers())
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
