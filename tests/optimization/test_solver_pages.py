"""The programs on the pages about covariance, singular and incremental problems and losses run and print what they say."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("page", ["covariance", "singular_problems", "robust_losses", "incremental"])
def test_programs_run_and_print_what_stands_below_them(page: str) -> None:
    scope: dict[str, object] = {}
    blocks = re.findall(r"```(python)?\n(.*?)```", (DOCS / f"{page}.md").read_text(encoding="utf-8"), re.DOTALL)
    printed = ""
    for language, text in blocks:
        if language:
            assert not printed, "a program prints what no block below it shows"
            out = io.StringIO()
            with contextlib.redirect_stdout(out):
                exec(compile(text, page, "exec"), scope)
            printed = out.getvalue()
        else:
            assert printed == text
            printed = ""
    assert not printed


def test_the_program_of_the_page_about_windows_runs() -> None:
    scope: dict[str, object] = {}
    text = (DOCS / "marginalization.md").read_text(encoding="utf-8")
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        for program in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
            exec(compile(program, "marginalization", "exec"), scope)
    first, second = out.getvalue().splitlines()
    assert first.startswith("[34 35 36 37 38 39]")
    assert second.startswith("True ['translation x: one sigma of the prior is ")
