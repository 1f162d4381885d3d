"""`--help` of every command: groups, placeholders, and examples that can be run as they stand."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from boxplus.cli import _COMMANDS, app
from boxplus.cli.terminal.examples import EXAMPLES


def commands(group: Any, ctx: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    """Every command that does something, by the words that call it."""
    for name in group.list_commands(ctx):
        _, command, _ = group.resolve_command(ctx, [name])
        path = f"{before}{name}"
        if hasattr(command, "list_commands"):
            yield from commands(command, command.make_context(name, [], parent=ctx, resilient_parsing=True), f"{path} ")
        else:
            yield path, command


ROOT = typer.main.get_command(app)
ALL = dict(commands(ROOT, ROOT.make_context("boxplus", [], resilient_parsing=True)))


def test_every_command_has_examples_and_nothing_else_has() -> None:
    assert set(ALL) == set(EXAMPLES)
    assert {path.split()[0] for path in ALL} == set(_COMMANDS)


@pytest.mark.parametrize(("path", "line"), [(path, line) for path, lines in EXAMPLES.items() for line, _ in lines])
def test_an_example_is_understood(path: str, line: str) -> None:
    words = shlex.split(line.split(" > ")[0])
    depth = 1 + len(path.split())
    assert words[:depth] == ["boxplus", *path.split()]
    context = ALL[path].make_context(path, words[depth:])  # refuses options and values that there are not
    assert all(context.params[param.name] not in (None, [], ()) for param in ALL[path].params if param.required)


@pytest.mark.parametrize("path", list(ALL))
def test_help_shows_examples_and_no_type_of_python(path: str) -> None:
    result = CliRunner().invoke(app, [*path.split(), "--help"], prog_name="boxplus")
    assert result.exit_code == 0
    assert all(f"\n  {line}" in result.stdout for line, _ in EXAMPLES[path])
    assert not re.search(r"<(path|str|int|float|list|bool)|list\[|\{", result.stdout.split("Examples:")[0].replace("{topic", ""))


def test_options_stand_in_groups() -> None:
    text = CliRunner().invoke(app, ["lio", "--help"], prog_name="boxplus").stdout
    headings = re.findall(r"^(\w[^\n]*):$", text, re.MULTILINE)
    reading = "Reading the recording (found from the data unless given)"
    assert headings == ["Arguments", "Results", "Settings", "On the terminal", reading, "Options", "Examples"]
    assert text.index("Results:") < text.index("--gt PATH") < text.index("Settings:") < text.index("--threads N")


def test_the_ground_truth_stands_with_the_results_in_every_command_that_takes_one() -> None:
    for name in ("lio", "slam", "refine", "vio", "vo"):
        text = CliRunner().invoke(app, [name, "--help"], env={"COLUMNS": "120"}).stdout
        results = re.split(r"\n(?=\S)", text.split("\nResults:")[1])[0]
        assert "\n  --gt " in results, name


def test_usage_says_what_may_be_left_out_and_what_may_be_repeated() -> None:
    for path, usage in (("lio", "RECORDING…"), ("pgo", "FILE"), ("simulate", "[SCENARIO]"), ("map update", "MAP RUN…")):
        assert (
            f"Usage: boxplus {path} [OPTIONS] {usage}\n"
            in CliRunner().invoke(app, [*path.split(), "--help"], prog_name="boxplus").stdout
        )


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["simulate", "wlak"], "got 'wlak' – did you mean walk? the scenarios are: walk, "),
        (["simulate", "walk", "--fault", "drop_scan"], "got 'drop_scan' – did you mean drop_scans"),
        (["lioo"], "No such command 'lioo': did you mean 'lio'?"),
        (["reprot", "out"], "No such command 'reprot': did you mean 'report'?"),
        (["xyzzy"], "No such command 'xyzzy': 'boxplus --help' lists them all"),
        (["map", "merg"], "No such command 'merg'. Did you mean 'merge'?"),
        (["lio", "--thread", "2", "a.bag"], "No such option: --thread (Possible options: --threads)"),
        (["slam", "a.bag", "b.bag"], "(b.bag): it takes one recording; 'boxplus fleet run' takes a folder of them and joins"),
        (["localize", "a.bag", "b.bag", "-m", "map"], "(b.bag): it takes one recording; call it once for each"),
        (["fleet", "run", "a", "b"], "(b): it takes one folder, or a .txt file with one path a line"),
        (["lio"], "Missing argument 'RECORDING'"),
        (["inspect"], "Missing argument 'RECORDING'"),
        (["pgo"], "Missing argument 'FILE'"),
        (["ba"], "Missing argument 'FILE'"),
        (["calibrate", "cameras"], "Missing argument 'CORNERS'"),
        (["eval", "a", "b", "--align", "se33"], "Invalid value for '--align': 'se33' is not one of 'se3'"),
    ],
)
def test_what_was_meant_is_asked(words: list[str], told: str) -> None:
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 2
    assert told in " ".join(result.stderr.replace("│", " ").split())


def test_a_shell_is_told_commands_and_options() -> None:
    def completions(line: str) -> str:
        environment = {"_BOXPLUS_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(line.split()) - 1)}
        return CliRunner().invoke(app, [], prog_name="boxplus", env=environment).stdout

    assert completions("boxplus lo").split() == ["localize"] or "localize" in completions("boxplus lo")
    assert "--threads" in completions("boxplus lio --thr").split()


def test_the_page_of_the_command_line_has_a_row_for_every_command() -> None:
    page = (Path(__file__).parents[3] / "docs" / "command_line.md").read_text(encoding="utf-8")
    table = page.partition("### Exit codes")[0]
    assert [path for path in ALL if not re.search(rf"`(boxplus )?{path}[` ]", table)] == []
    (told,) = re.findall(r"^(.*) take `--json` and `--quiet`", page, re.MULTILINE)
    both = {path for path, command in ALL.items() if {"--json", "--quiet"} <= {name for p in command.params for name in p.opts}}
    assert set(re.findall(r"`([^`]+)`", told)) == {"calibrate" if path.startswith("calibrate") else path for path in both}


def test_a_command_that_may_end_without_trust_says_so_itself() -> None:
    page = (Path(__file__).parents[3] / "docs" / "command_line.md").read_text(encoding="utf-8")
    (row,) = (line for line in page.splitlines() if line.startswith("| 3 |"))
    named = [path for path in re.findall(r"`([a-z -]+)`", row) if path in ALL]
    assert len(named) > 5
    silent = [path for path in named if not re.search(r"\b3\b|as 'boxplus lio'", re.sub(r"\s+", " ", ALL[path].help or ""))]
    assert not silent
