"""The page of refinement lists every setting with its default."""

from __future__ import annotations

import re
from pathlib import Path

from boxplus.systems.refinement.config import RefinementConfig

PAGE = Path(__file__).resolve().parents[3] / "docs" / "refinement.md"


def test_every_setting_is_listed_with_its_default() -> None:
    listed = dict(re.findall(r"^\| `(\w+)` \| `?([\w.-]+)`? \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE))
    defaults = {name: field.default for name, field in RefinementConfig.model_fields.items()}
    assert set(listed) == set(defaults)
    for name, default in defaults.items():
        if isinstance(default, (bool, str)):
            assert listed[name] == str(default).lower()
        else:
            assert float(listed[name]) == default
