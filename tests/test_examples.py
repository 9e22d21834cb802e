"""Every example runs as it is and leaves its picture."""

import runpy
from pathlib import Path

import pytest

import shapeenh as se

EXAMPLES = sorted((Path(__file__).parent.parent / "examples").glob("*.py"))


@pytest.mark.parametrize(
    "example",
    [
        pytest.param(e, marks=pytest.mark.slow if e.stem == "fit_environments" else pytest.mark.thorough, id=e.stem)
        for e in EXAMPLES
    ],
)
def test_every_example_runs(example, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [str(example)])
    runpy.run_path(str(example), run_name="__main__")
    picture = se.load_image(tmp_path / f"{example.stem}.png")
    assert min(picture.shape[:2]) > 100
    assert picture.std() > 0
