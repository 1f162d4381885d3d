"""The programs on the pages of the IMU, photometric and point cloud errors run and print what their comments say."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import pytest

PAGES = Path(__file__).resolve().parents[2] / "docs" / "residuals"


@pytest.mark.parametrize("page", ["imu_preintegration", "photometric", "point_to_plane"])
def test_programs_print_what_they_promise(page: str) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (PAGES / f"{page}.md").read_text(encoding="utf-8"), re.DOTALL)
    assert blocks
    names: dict[str, object] = {}  # a page goes on where its last program ended
    for block in blocks:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(block, page, "exec"), names)
        promised = re.findall(r"^print\(.*\) +# (.*)$", block, re.MULTILINE)
        assert promised and printed.getvalue().splitlines() == promised
