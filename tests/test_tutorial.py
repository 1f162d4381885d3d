"""The tutorial is a notebook that runs from top to bottom, and prints what it shows."""

from __future__ import annotations

import contextlib
import io
import json
import re
from pathlib import Path
from typing import Any

import pytest

NOTEBOOK = Path(__file__).resolve().parents[1] / "docs" / "tutorial.ipynb"


def cells() -> list[dict[str, Any]]:
    book = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert (book["nbformat"], book["nbformat_minor"]) == (4, 5)
    return list(book["cells"])


def tags(cell: dict[str, Any]) -> list[str]:
    return list(cell["metadata"].get("tags", []))


def shown(cell: dict[str, Any]) -> str:
    return "".join(text for output in cell["outputs"] if output["output_type"] == "stream" for text in output["text"])


def without_numbers(text: str) -> str:
    return re.sub(r"[-+−]?\d[\d.,]*(e[-+]?\d+)?", "#", text)


def test_the_estimator_has_forty_lines() -> None:
    lines = [line for cell in cells() if "estimator" in tags(cell) for line in "".join(cell["source"]).splitlines()]
    assert 0 < len([line for line in lines if line.strip()]) <= 40


def test_the_notebook_is_small() -> None:
    assert NOTEBOOK.stat().st_size < 100_000
    kinds = [output["output_type"] for cell in cells() if cell["cell_type"] == "code" for output in cell["outputs"]]
    assert set(kinds) == {"stream", "display_data"} and kinds.count("display_data") == 1


@pytest.mark.slow
def test_every_cell_runs_and_prints_what_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib.pyplot as plt

    plt.switch_backend("Agg")
    monkeypatch.setattr(plt, "show", lambda: None)
    scope: dict[str, Any] = {}
    for number, cell in enumerate(cells()):
        if cell["cell_type"] != "code":
            continue
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile("".join(cell["source"]), f"cell {number}", "exec"), scope)
        now, then = without_numbers(printed.getvalue()), without_numbers(shown(cell))
        if "error" in tags(cell):  # its wording has tests of its own
            now, then = now.splitlines()[-1][:40], then.splitlines()[-1][:40]
        assert now == then, f"cell {number}"
    assert len(plt.get_fignums()) == 1
    plt.close("all")
    # What the text claims.
    assert scope["solution"].status == "converged"
    assert 2.0 < scope["np"].mean(scope["nees_poses"]) < 4.0
    assert 1.3 < scope["np"].mean(scope["nees_landmarks"]) < 2.7
    assert not scope["bp"].check_jacobian(scope["mistaken"], *scope["somewhere"]).passed
