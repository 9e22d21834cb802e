"""The tables of README and docs, from `results/*.json`: `python -m benchmarks.tables` writes them between their marks.

`<!-- table: NAME -->` and `<!-- end of table -->` enclose what the benchmark NAME measured. A full run of `python -m
benchmarks` ends with this.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

from benchmarks.harness import RESULTS

ROOT = Path(__file__).parent.parent


def markdown(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def ms(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.1f}"


def frame(found: dict) -> str:
    """A row per stage, a column per mesh."""
    rows = found["rows"]
    meshes = list(dict.fromkeys(r["mesh"] for r in rows))
    at = {(r["mesh"], r["stage"]): r for r in rows}
    stages = list(dict.fromkeys(r["stage"] for r in rows))
    thousands = lambda n: f"{round(n / 1000)}k"  # noqa: E731
    head = ["ms, median"]
    for mesh in meshes:
        first = at[mesh, stages[0]]
        head.append(f"{mesh} ({thousands(first['triangles'])} triangles, {thousands(first['covered'])} pixels)")
    return markdown(head, [[s, *(ms(at[m, s]["median_ms"]) for m in meshes)] for s in stages])


def skipping(found: dict) -> str:
    """A row per thing that is skipped."""
    head = ["skipped", "general, ms", "skipping, ms", "saved", "difference"]
    rows = []
    for r in found["rows"]:
        difference = "another picture" if r["difference"] is None else f"{r['difference']:.1e}"
        rows.append([r["skipped"], ms(r["general_ms"]), ms(r["skipping_ms"]), f"{100 * r['saved']:.0f} %", difference])
    return markdown(head, rows)


def precision(found: dict) -> str:
    """A row per stage, the worst of all meshes."""
    measures = ("median", "99 %", "max")
    head = ["stage", *(f"{kind}: {m}" if m == "median" else m for kind in ("own", "cumulative") for m in measures)]
    head += ["pixels > 1 %"]
    worst: dict[tuple, float] = {}
    for r in found["rows"]:
        for m in (*measures, "pixels > 1e-2"):
            key = r["stage"], r["error"], m
            worst[key] = max(worst.get(key, 0.0), r[m])
    number = lambda x: f"{x:.1e}".replace("e-0", "e-")  # noqa: E731
    stages = dict.fromkeys(r["stage"] for r in found["rows"])
    return markdown(
        head,
        [
            [s, *(number(worst[s, kind, m]) for kind in ("own", "cumulative") for m in measures)]
            + [f"{worst[s, 'cumulative', 'pixels > 1e-2']:.0f}"]
            for s in stages
        ],
    )


def gradients(found: dict) -> str:
    """What was measured; a row per stage and what it is differentiated in."""
    said = (
        f"The {found['mesh']} at {found['size']}, {found['lights']} lights, float32, {found['machine']['cores']} cores:"
    )
    head = ["stage", "gradient in", "value, ms", "value and gradient, ms", "times"]
    rows = [
        [r["stage"], r["in"], ms(r["value_ms"]), ms(r["with_gradient_ms"]), f"{r['ratio']:.1f}"] for r in found["rows"]
    ]
    return f"{said}\n\n{markdown(head, rows)}"


def pages(found: dict) -> str:
    """A row per call, a column per setting."""
    ratios = {"ratio": "kept / fresh", "wide_ratio": "wide / kept"}
    settings = [name for name in found["rows"][0] if name not in ("call", *ratios)]
    rows = [[r["call"], *(ms(r[n]) for n in settings), *(f"{r[n]:.2f}" for n in ratios)] for r in found["rows"]]
    return markdown(["call", *(f"{name}, ms" for name in settings), *ratios.values()], rows)


TABLES = {
    "frame": ("README.md", frame),
    "gradients": ("docs/gradients.md", gradients),
    "pages": ("docs/skipping.md", pages),
    "precision": ("docs/precision.md", precision),
    "skipping": ("docs/skipping.md", skipping),
}


def filled(page: str, name: str, table: str) -> str:
    """The page with what stands between the marks of the table replaced."""
    mark, end = f"<!-- table: {name} -->", "<!-- end of table -->"
    pattern = re.compile(re.escape(mark) + r".*?" + re.escape(end), re.DOTALL)
    if not pattern.search(page):
        raise ValueError(f"no {mark} ... {end} in the page")
    return pattern.sub(lambda _: f"{mark}\n{table}\n{end}", page)


def main() -> None:
    for name, (file, made) in TABLES.items():
        results, page = RESULTS / f"{name}.json", ROOT / file
        if results.exists():
            page.write_text(filled(page.read_text(), name, made(json.loads(results.read_text()))))
            print(f"{file}: {name}")


if __name__ == "__main__":
    main()
