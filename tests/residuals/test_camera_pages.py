"""The Python on the pages of cameras and of their residuals runs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGES = ["cameras", "residuals/reprojection", "visual_inertial"]


@pytest.mark.parametrize("page", PAGES)
def test_python_of_the_page_runs(page: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert blocks
    exec("\n".join(blocks), {})
    printed = capsys.readouterr().out
    assert printed.split() == [word for shown in re.findall(r"^print.*?# (.*)$", text, re.MULTILINE) for word in shown.split()]


@pytest.mark.parametrize("page", [path.stem for path in DOCS.glob("residuals/*.md")])
def test_links_and_pictures_of_the_page_exist(page: str) -> None:
    path = DOCS / "residuals" / f"{page}.md"
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", path.read_text(encoding="utf-8")):
        assert target.startswith("http") or (path.parent / target).exists(), f"{page}: {target}"
