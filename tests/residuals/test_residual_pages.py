"""The pages of the residuals: all are listed, every residual has one, and their programs print what their comments say."""

from __future__ import annotations

import contextlib
import inspect
import io
import re
from pathlib import Path

import pytest

from boxplus import residuals

PAGES = Path(__file__).resolve().parents[2] / "docs" / "residuals"
INDEX = (PAGES / "index.md").read_text(encoding="utf-8")
ROWS = [line.split("|")[1:-1] for line in INDEX.splitlines() if line.startswith("| `")]

WITH_PROGRAM = [
    "antenna_position",
    "bal_reprojection",
    "chordal_pose",
    "gravity_direction",
    "inverse_depth",
    "inverse_depth_intrinsics",
    "line_reprojection",
    "marginal_prior",
    "on_body",
    "prior",
    "relative_pose",
    "reprojection_intrinsics",
]


def test_every_page_is_listed() -> None:
    listed = set(re.findall(r"\]\((\w+\.md)\)", INDEX))
    assert listed == {page.name for page in PAGES.glob("*.md")} - {"index.md"}


def test_every_residual_is_listed_with_a_page_that_shows_it() -> None:
    pages = {name: cells[-1] for cells in ROWS for name in re.findall(r"`(\w+)`", cells[0])}
    kinds = {
        name
        for name in residuals.__all__
        if inspect.isclass(kind := getattr(residuals, name)) and issubclass(kind, residuals.Residual)
    }
    assert set(pages) == kinds - {"Residual"}
    for name, cell in pages.items():
        (page,) = re.findall(r"\((\w+\.md)\)", cell)
        assert f"{name}(" in (PAGES / page).read_text(encoding="utf-8"), f"{page} does not show {name}"


@pytest.mark.parametrize("page", WITH_PROGRAM)
def test_programs_print_what_they_promise(page: str) -> None:
    (block,) = re.findall(r"```python\n(.*?)```", (PAGES / f"{page}.md").read_text(encoding="utf-8"), re.DOTALL)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(block, page, "exec"), {})
    promised = re.findall(r"^print\(.*\) +# (.*)$", block, re.MULTILINE)
    assert promised and printed.getvalue().splitlines() == promised
