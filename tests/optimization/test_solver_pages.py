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
