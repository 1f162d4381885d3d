"""The command line: `boxplus COMMAND`. Commands are imported when they are called, so that the first word appears at once."""

from __future__ import annotations

import atexit
import errno
import gc
import importlib
import io
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from boxplus.errors import BoxplusError, InputError, printable

EXIT_FAILED, EXIT_BAD_INPUT, EXIT_UNTRUSTED, EXIT_INTERRUPTED = 1, 2, 3, 130

_COMMANDS = {
    "lio": ("boxplus.cli.lidar.lio:lio", "Turn a recording into a trajectory, a map and a report."),
    "slam": (
        "boxplus.cli.lidar.slam:slam",
        "The same with loops closed: corrected trajectory and map beside the odometry's own.",
    ),
    "refine": (
        "boxplus.cli.lidar.refine:refine_command",
        "Refine a finished run of lio or slam: all poses, planes and IMU samples at once.",
    ),
    "localize": ("boxplus.cli.lidar.localize:localize", "Find where a recording is in a saved map, and follow it there."),
    "vio": ("boxplus.cli.cameras.vio:vio", "Turn a recording of cameras and an IMU into a trajectory, landmarks and a report."),
    "vo": ("boxplus.cli.cameras.vo:vo", "Turn a recording of an RGB-D or a stereo camera into a trajectory and a report."),
    "ba": ("boxplus.cli.optimization.ba:ba", "Adjust cameras and points of a BAL file or a COLMAP model."),
    "pgo": ("boxplus.cli.optimization.pgo:pgo", "Optimise the poses of a g2o or TORO pose graph."),
    "inspect": ("boxplus.cli.inspect:inspect", "Examine a recording: topics, rates, gaps, times, units, extrinsic."),
    "calibrate": ("boxplus.cli.calibrate:app", "Find mounting, clock offset and scales of sensors from a recording."),
    "eval": ("boxplus.cli.eval:evaluate_command", "Compare a trajectory with the ground truth: ATE, RPE."),
    "convert": ("boxplus.cli.convert:convert_command", "Write a trajectory, cloud, graph or reconstruction in another format."),
    "map": ("boxplus.cli.lidar.map:map_app", "Join runs into one map, look into a map, or write it as one file."),
    "fleet": ("boxplus.cli.lidar.fleet:app", "Run many recordings, on this machine or a cluster, and join those that met."),
    "report": ("boxplus.cli.report:report", "Draw the report of a run again, also of an interrupted one."),
    "simulate": ("boxplus.cli.simulate:simulate_command", "Compute a recording with exact ground truth."),
    "demo": ("boxplus.cli.demo:demo", "Simulate a walk, run the odometry on it and compare with the truth."),
    "warmup": ("boxplus.cli.warmup:warmup", "Compile everything now, so that the first run does not have to."),
}


@contextmanager
def uncollected() -> Iterator[None]:
    """While a command imports what it needs: it stays; to look for garbage among it again and again is a tenth of a short run."""
    collected = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collected:
            if not gc.get_freeze_count():  # once in a process
                gc.freeze()
            gc.enable()


class _Commands(TyperGroup):
    """Imports a command when it is called, and turns boxplus' errors into one paragraph and an exit code."""

    def list_commands(self, ctx: Any) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """A stand-in with the help text, which is all a listing needs."""
        if cmd_name not in _COMMANDS:
            return None
        stand_in = typer.Typer(add_completion=False, rich_markup_mode=None)
        stand_in.command(cmd_name, help=_COMMANDS[cmd_name][1])(lambda: None)
        return typer.main.get_command(stand_in)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """All of each sentence."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in _COMMANDS.items()])

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] not in _COMMANDS and not args[0].startswith("-") and not ctx.resilient_parsing:
            close = [repr(name) for name in get_close_matches(args[0], _COMMANDS)]
            meant = f"did you mean {' or '.join(close)}?" if close else "'boxplus --help' lists them all"
            ctx.fail(f"No such command {args[0]!r}: {meant}")
        name, command, rest = super().resolve_command(ctx, args)
        if name is None or command is None:
            return name, command, rest
        from boxplus.cli.terminal.help import Command

        module, _, attribute = _COMMANDS[name][0].partition(":")
        found = getattr(importlib.import_module(module), attribute)
        if not isinstance(found, typer.Typer):
            single = typer.Typer(add_completion=False, rich_markup_mode=None)
            single.command(name, cls=Command)(found)
            found = single
        return name, typer.main.get_command(found), rest

    def invoke(self, ctx: Any) -> Any:
        try:
            result = super().invoke(ctx)
            sys.stdout.flush()
            return result
        except BoxplusError as error:
            print_error(str(error))
            raise typer.Exit(EXIT_BAD_INPUT if isinstance(error, InputError) else EXIT_FAILED) from None
        except KeyboardInterrupt:
            typer.echo("interrupted", err=True)
            raise typer.Exit(EXIT_INTERRUPTED) from None
        except OSError as error:
            if error.errno != errno.ENOSPC or error.filename is not None:
                raise
            print_error(f"expected to write to the standard output – got {error.strerror} – make room where it is kept")
            # What is still to be written would be tried once more at the end, and the exit code be Python's.
            with suppress(OSError, ValueError), open(os.devnull, "w") as nowhere:
                os.dup2(nowhere.fileno(), sys.stdout.fileno())
            raise typer.Exit(EXIT_FAILED) from None


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # brackets in help texts are units and extras, not markup
    context_settings={"help_option_names": ["-h", "--help"]},
    help="boxplus: LiDAR-inertial and visual-inertial odometry, bundle adjustment, pose graphs, and their tools.",
)


class _LogFormatter(logging.Formatter):
    """Log lines may quote a file."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


def print_error(text: str) -> None:
    """On the standard error."""
    typer.secho("error: ", fg="red", bold=True, nl=False, err=True)
    typer.echo(text, err=True)


def _print_version(wanted: bool) -> None:
    if wanted:
        import boxplus

        typer.echo(f"boxplus {boxplus.__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Print the log as well.")] = False,
) -> None:
    handler = logging.StreamHandler()
    handler.setFormatter(_LogFormatter("%(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=logging.INFO if verbose else logging.ERROR, handlers=[handler])
    logging.getLogger("boxplus").setLevel(logging.INFO if verbose else logging.WARNING)


def main() -> None:
    """Entry point of the command `boxplus`."""
    if "OMP_NUM_THREADS" not in os.environ:  # our threads call BLAS; its own would have to be started, and wait spinning
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for stream in (sys.stdout, sys.stderr):  # a pipe under Windows knows no χ² and no arrow; results are not to end with it
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    if threading.current_thread() is threading.main_thread():  # SIGTERM as Ctrl-C, also while a command is still imported
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    atexit.register(gc.freeze)  # what is left goes with the process; to look for garbage among it takes a seventh of a second
    app(prog_name="boxplus")
