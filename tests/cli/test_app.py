"""The command line as a whole: help, version, and what it imports."""

from __future__ import annotations

import subprocess
import sys

import pytest
from typer.testing import CliRunner

import boxplus
from boxplus.cli import _COMMANDS, app


def test_help_lists_every_command() -> None:
    result = CliRunner().invoke(app, ["--help"])
    assert result.exit_code == 0
    for name in _COMMANDS:
        assert f" {name} " in result.stdout


@pytest.mark.parametrize("name", list(_COMMANDS))
def test_every_command_has_help_of_its_own(name: str) -> None:
    result = CliRunner().invoke(app, [name, "--help"], env={"COLUMNS": "120"})
    assert result.exit_code == 0, result.output
    assert f" {name} " in result.stdout


def test_help_keeps_what_stands_in_brackets() -> None:
    result = CliRunner().invoke(app, ["lio", "--help"], env={"COLUMNS": "120"})
    assert "boxplus[view]" in result.stdout
    assert "[m]" in result.stdout


def test_version() -> None:
    result = CliRunner().invoke(app, ["--version"])
    assert (result.exit_code, result.stdout) == (0, f"boxplus {boxplus.__version__}\n")


def test_unknown_command() -> None:
    result = CliRunner().invoke(app, ["oi"])
    assert result.exit_code == 2
    assert "No such command 'oi'" in result.stderr


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; sys.argv = ['boxplus', '--help']\n"
        "from boxplus.cli import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "print('heavy:', *sorted({'numpy', 'numba', 'scipy', 'rosbags', 'plotly', 'matplotlib', 'pydantic'} & set(sys.modules)))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.splitlines()[-1].strip() == "heavy:"
