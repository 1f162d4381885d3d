"""Libraries that are not always installed: what is said where one is missing."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

import pytest

from boxplus import _extras
from boxplus.errors import InputError, RecordingError

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_every_library_is_declared_in_the_extra_that_is_named() -> None:
    for name, extra in _extras._LIBRARIES.values():
        if name == "dpkt" or extra is None:  # what velodyne-decoder brings; what is installed on its own
            continue
        names = [re.split(r"[\[>=;]", text)[0].lower() for text in PROJECT["optional-dependencies"][extra]]
        assert any(found.startswith(name.lower()) for found in names), (name, extra, names)


def test_a_missing_library_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    text = re.escape(f"Ray, which runs tasks – got it is not installed – {_extras.installation('fleet')}")
    with pytest.raises(InputError, match=text):
        _extras.require("ray", "which runs tasks")
    with pytest.raises(RecordingError, match=text):
        _extras.require("ray", "which runs tasks", RecordingError)
    assert not _extras.has("ray")


def test_what_cannot_be_an_extra_is_installed_without_the_libraries_it_pins(monkeypatch: pytest.MonkeyPatch) -> None:
    """With them, pip would put an older rosbags in the place of ours."""
    monkeypatch.setitem(sys.modules, "ouster", None)
    monkeypatch.setitem(sys.modules, "ouster.sdk", None)
    with pytest.raises(InputError, match=r"install --no-deps 'ouster-sdk>=1\.0'$"):
        _extras.require("ouster.sdk", "which decodes this capture")


def test_a_library_that_is_broken_says_how(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delitem(sys.modules, "laspy", raising=False)
    (tmp_path / "laspy.py").write_text("import no_such_library\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match="it cannot be imported: No module named 'no_such_library'"):
        _extras.require("laspy", "which reads LAS files")


def test_what_is_advised_installs_the_libraries_and_asks_no_index_for_boxplus(monkeypatch: pytest.MonkeyPatch) -> None:
    """boxplus is on none."""
    required = [f'{text}; extra == "{extra}"' for extra, own in PROJECT["optional-dependencies"].items() for text in own]
    monkeypatch.setattr(_extras.importlib.metadata, "requires", lambda name: ["numpy>=2", *required])
    line = _extras.installation("las")
    assert line.endswith("-m pip install 'laspy>=2.5.4' 'lazrs>=0.6'") and line.startswith(sys.executable)
    monkeypatch.setattr(_extras, "has", lambda *names: False)
    assert _extras.installation("view") == f"uv pip install --python {sys.executable} 'rerun-sdk>=0.23'"
    monkeypatch.setattr(_extras.sys, "executable", r"C:\my tools\python.exe")
    monkeypatch.setattr(_extras.os, "name", "nt")  # whose shell knows no single quotes
    line = _extras.installation("view")
    monkeypatch.undo()
    assert line == r'uv pip install --python "C:\my tools\python.exe" rerun-sdk>=0.23'


def test_a_clone_that_was_not_installed_is_named_with_its_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(name: str) -> list[str]:
        raise _extras.importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(_extras.importlib.metadata, "requires", unknown)
    assert _extras.installation("view").endswith(f"pip install '{Path(_extras.__file__).parents[1]}[view]'")


def test_nowhere_is_boxplus_to_be_installed_from_an_index() -> None:
    root = Path(__file__).parents[1]
    for path in (*(root / "boxplus").rglob("*.py"), *(root / "docs").glob("*.md"), root / "README.md"):
        assert not re.search(r"pip install\s+'?boxplus\b", path.read_text(encoding="utf-8")), path
