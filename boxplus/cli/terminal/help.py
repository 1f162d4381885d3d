"""How `--help` of a command looks: options in groups, then examples."""

from __future__ import annotations

import re
from typing import Any

import typer
from typer.core import TyperCommand

from boxplus.cli.terminal.examples import EXAMPLES

_VALUES = {"path": "PATH", "int": "N", "int range": "N", "float": "X", "float range": "X", "str": "TEXT", "list[str]": "TEXT"}
"""What stands for a value, by the name that typer has for its type."""

_UsageError: Any = typer.BadParameter.__base__  # of the click that typer brings along
_ONE_ONLY = {
    "slam": "it takes one recording; 'boxplus fleet run' takes a folder of them and joins those that met, 'boxplus map merge' "
    "joins runs that are there",
    "localize": "it takes one recording; call it once for each",
    "fleet run": "it takes one folder, or a .txt file with one path a line",
}
"""Commands of one recording, and what to do with several."""


class Command(TyperCommand):
    """A command whose help shows its options under the names of their panels, and examples of how it is called."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """What is wrong with a value, without the word that the library for checking values puts before it."""
        try:
            return list(super().parse_args(ctx, args))
        except typer.BadParameter as error:
            error.message = error.message.removeprefix("Value error, ")
            raise
        except _UsageError as error:
            known: Any = error
            advice = _ONE_ONLY.get(ctx.command_path.partition(" ")[2])
            if advice is not None and known.message.startswith("Got unexpected extra argument"):
                known.message = f"{known.message}: {advice}"
            raise

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """`RECORDING…` for what may be repeated, `[SCENARIO]` for what may be left out."""
        return ["[OPTIONS]", *(_usage(param) for param in self.get_params(ctx) if param.param_type_name == "argument")]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Arguments first, then the groups in the order of their first option, and what belongs to none."""
        sections: dict[str, list[tuple[str, str]]] = {"Arguments": []}
        others: list[tuple[str, str]] = []
        for param in self.get_params(ctx):
            record = param.get_help_record(ctx)
            if record is None:
                continue
            names, text = record
            panel = getattr(param, "rich_help_panel", None)
            if param.param_type_name == "argument":
                sections["Arguments"].append((_name(param), text.removesuffix("[required]").rstrip()))
            else:
                names = re.sub(r"<([^<>|]*)>", lambda found: _VALUES.get(found[1], found[1]), names)
                (others if panel is None else sections.setdefault(panel, [])).append((names, text))
        for heading, records in {**sections, "Options": others}.items():
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """The examples, each in a line of its own that can be copied."""
        examples = EXAMPLES.get(ctx.command_path.partition(" ")[2], ())
        if examples:
            with formatter.section("Examples"):
                for line, what in examples:
                    comment = f"{'':>{formatter.current_indent}}# {what}\n" if what else ""
                    formatter.write(f"{comment}{'':>{formatter.current_indent}}{line}\n")


def _name(argument: Any) -> str:
    name = str(argument.metavar or argument.name.upper()).rstrip("…")
    return f"{name}…" if argument.nargs == -1 else name


def _usage(argument: Any) -> str:
    return _name(argument) if argument.required else f"[{_name(argument)}]"
