"""The documentation as a site: every page has a place of its own, and links of files outside of docs/ lead somewhere."""

from __future__ import annotations

import posixpath
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).resolve().parents[1]
pytest.importorskip("mkdocs")
pytest.importorskip("mkdocstrings")
pytest.importorskip("material")


def test_no_page_takes_the_place_of_another() -> None:
    """A page that linked to README.md made it the first page of the site, with none of its links and pictures there."""
    from mkdocs.config import load_config
    from mkdocs.structure.files import get_files

    config = load_config(str(ROOT / "mkdocs.yml"))
    (hook,) = config.hooks.values()
    files = config.plugins.run_event("files", get_files(config), config=config)
    pages = [file for file in files if file.is_documentation_page()]
    assert {name for name, count in Counter(file.dest_uri for file in pages).items() if count > 1} == set()
    assert [file.src_uri for file in pages if file.dest_uri == "index.html"] == ["index.md"]
    readme = hook.page_of("README.md")
    text = hook.on_page_markdown((ROOT / "README.md").read_text(), SimpleNamespace(file=SimpleNamespace(src_uri=readme)))
    known = {file.src_uri for file in files}
    assert readme in known
    for target, _ in hook.LINK.findall(text):
        assert "://" in target or posixpath.normpath(posixpath.join(posixpath.dirname(readme), target)) in known, target
