"""`boxplus warmup`: its parts in processes of their own."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from boxplus.cli import app, warmup


def test_a_part_that_fails_is_named_and_the_command_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    assert warmup._compile_apart("no such part") == (set(), "no such part: KeyError: 'no such part'")
    monkeypatch.setattr(warmup, "_PARTS", {"no such part": None})
    result = CliRunner().invoke(app, ["warmup"])
    assert result.exit_code == 1
    assert "kernels cannot be compiled: no such part: KeyError: 'no such part'" in result.stderr


def test_what_parts_compiled_is_counted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    names = {"first": {"a", "b"}, "second": {"b"}}
    monkeypatch.setattr(warmup, "_PARTS", names)
    monkeypatch.setattr(warmup, "_compile_apart", lambda part: (names[part], ""))
    result = CliRunner().invoke(app, ["warmup"])
    assert result.exit_code == 0 and result.stdout.startswith("2 kernels compiled in ")
    monkeypatch.setattr(warmup, "_compile_apart", lambda part: (set(), ""))
    assert CliRunner().invoke(app, ["warmup"]).stdout.startswith("nothing to compile, all kernels were ready in ")
