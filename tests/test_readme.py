"""What the README promises: its Python runs as printed, and CI runs its test command."""

import re
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


@pytest.mark.slow
def test_the_python_of_the_readme_runs_as_printed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in re.findall(r"```python\n(.*?)```", README, flags=re.S):
        exec(block, names)
    assert (tmp_path / "knot.png").exists()
    assert names["image"].shape == (600, 800, 3)
    assert np.isfinite(names["slope"])
    assert names["slope"] != 0


def test_ci_runs_the_test_command_of_the_readme():
    command = README.split("<!-- test command -->")[1].split("```")[1]
    assert "pip install" in command
    assert "pytest --slow" in command
    assert "test command" in (ROOT / ".ci" / "run").read_text()


def test_every_document_that_the_readme_names_exists():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / target).exists(), target
