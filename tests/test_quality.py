"""ruff and mypy find nothing; results that benchmarks keep can be kept."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks.harness import machine

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize("command", [["ruff", "check", "."], ["ruff", "format", "--check", "."], ["mypy"]])
def test_static_checks(command):
    done = subprocess.run([sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_rasteriser_s_kept_results_are_of_a_comparable_machine():
    """`benchmarks.raster --add` drops what another machine measured: one more entry in `machine()` drops all of it."""
    kept = json.loads((ROOT / "benchmarks" / "results" / "raster.json").read_text())
    assert kept["machine"].keys() == machine().keys()
