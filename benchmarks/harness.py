"""What every benchmark shares: interleaved timing with compile apart, a table, JSON with the machine, a plot, meshes
and maps.

With the environment variable BENCHMARKS_QUICK (`python -m benchmarks --quick` sets it) everything is timed three times
at most, and results go to a folder of their own: a rough look, and a test that every script runs.
"""

from __future__ import annotations

import json
import os
import platform
import random
import statistics
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import shapeenh as se

QUICK = bool(os.environ.get("BENCHMARKS_QUICK"))
RESULTS = Path(__file__).parent / "results" / ("quick" if QUICK else "")
_first: list[dict[str, float]] = []  # the first calls of every `measure`, which compile: `write` keeps them


def measure(calls: dict, *, repeats: int = 9, seconds: float = 20.0) -> dict[str, dict[str, float]]:
    """Time functions of no arguments in turns, so that a slow phase of the machine hits all of them alike; in another
    order each time, so that none always finds the caches as the same other one leaves them.

    Returns per name: `first_ms` (compile and run), `median_ms`, `min_ms`, `runs`.
    """
    if QUICK:
        repeats, seconds = min(repeats, 3), min(seconds, 2.0)
    times: dict[str, list[float]] = {name: [] for name in calls}
    first = {name: _milliseconds(call) for name, call in calls.items()}
    _first.append({str(name): round(ms, 3) for name, ms in first.items()})
    order, shuffle = list(calls), random.Random(0).shuffle
    start = time.perf_counter()
    for _ in range(repeats):
        shuffle(order)
        for name in order:
            times[name].append(_milliseconds(calls[name]))
        if time.perf_counter() - start > seconds:
            break
    return {
        name: {
            "first_ms": round(first[name], 3),
            "median_ms": round(statistics.median(t), 3),
            "min_ms": round(min(t), 3),
            "runs": len(t),
        }
        for name, t in times.items()
    }


def _milliseconds(call) -> float:
    start = time.perf_counter()
    jax.block_until_ready(call())
    return (time.perf_counter() - start) * 1e3


def machine() -> dict:
    """What the numbers were measured on."""
    return {
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "processor": _processor(),
        "system": platform.system(),
        "device": jax.devices()[0].device_kind,
        "python": platform.python_version(),
        "jax": jax.__version__,
        "numpy": np.__version__,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def table(rows: list[dict]) -> str:
    """Rows of equal keys as an aligned text table."""
    if not rows:
        return "(nothing)"
    keys = list(rows[0])
    text = [[str(k) for k in keys]] + [[_text(row.get(k)) for k in keys] for row in rows]
    widths = [max(len(line[i]) for line in text) for i in range(len(keys))]
    align = lambda line: "  ".join(c.rjust(w) if i else c.ljust(w) for i, (c, w) in enumerate(zip(line, widths)))  # noqa: E731, B905
    return "\n".join(align(line) for line in text)


def _text(value) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "" if value is None else str(value)


def write(name: str, rows: list[dict], **more) -> Path:
    """`results/NAME.json`: the machine, the rows, what the first calls took, and whatever else there is to say."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps({"machine": machine(), **more, "rows": rows, "first_ms": _first}, indent=1) + "\n")
    return path


def pareto(name: str, series: dict[str, list[tuple]], *, default: str, title: str, error: str) -> Path | None:
    """`results/NAME.png`: milliseconds against error, one line per series of (label, ms, error), the default ringed.

    Scales are logarithmic; where an error is 0, that of errors is linear below the smallest other one. None, and a
    word, where matplotlib (the extra `bench`) is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        print("no plot: matplotlib is missing (pip install shapeenh[bench])")
        return None
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel="milliseconds", ylabel=error, title=title)
    errors = [p[2] for points in series.values() for p in points]
    if min(errors) <= 0 < max(errors):
        axes.set_yscale("symlog", linthresh=min(e for e in errors if e > 0))
    for label, points in series.items():
        axes.plot([p[1] for p in points], [p[2] for p in points], "o-", label=label, markersize=4)
        for text, ms, value in points:
            axes.annotate(text, (ms, value), textcoords="offset points", xytext=(4, 4), fontsize=7)
            if text == default or f"{label} {text}" == default:
                axes.plot(ms, value, "o", markersize=13, markerfacecolor="none", markeredgecolor="black")
    axes.grid(alpha=0.3, which="both")
    if len(series) > 1:
        axes.legend(fontsize=8)
    RESULTS.mkdir(parents=True, exist_ok=True)
    path = RESULTS / f"{name}.png"
    figure.savefig(path, dpi=100)
    return path


def data(name: str) -> Path | None:
    """A file of the folder SHAPEENH_DATA (meshes and maps that are not part of the repository), or None."""
    folder = os.environ.get("SHAPEENH_DATA")
    path = Path(folder) / name if folder else None
    return path if path is not None and path.exists() else None


def meshes(paths=(), names=("bunny", "armadillo"), *, knot: bool = False) -> dict[str, se.Mesh]:
    """By name: the files of `paths`; else those of `names` that the data folder has, and, where it has none or where
    `knot` asks for it, the embedded object."""
    found = paths or [p for p in map(data, (f"{name}.obj" for name in names)) if p]
    loaded = {Path(p).stem: se.load_mesh(p) for p in found}
    return loaded | {"knot": se.carved_knot()} if not loaded or (knot and not paths) else loaded


def maps(names=("studio", "venice"), *, embedded: bool = True) -> dict[str, jax.Array]:
    """By name: the embedded radiance maps, and those of `names` that the data folder has, without negative pixels."""
    made = {"studio": se.procedural_studio(), "sky": se.procedural_sky()} if embedded else {}
    files = {f"{name}.exr": data(f"{name}.exr") for name in names}
    return made | {name: jnp.maximum(se.load_environment(path), 0) for name, path in files.items() if path}
