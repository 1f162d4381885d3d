"""What `boxplus ba` and `boxplus pgo` print: a row for every step, and results at the end."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

from rich import box
from rich.table import Table
from rich.text import Text

from boxplus.cli.optimization.options import MethodChoice
from boxplus.cli.terminal.terminal import Terminal

if TYPE_CHECKING:
    from boxplus.cli.terminal.outcome import Outcome
    from boxplus.optimization.losses import Loss
    from boxplus.optimization.solution import Iteration, Solution
    from boxplus.runs.optimization_summary import OptimizationSummary

_LAST = "of the last of several solves, which began where the others led"
_WIDTHS = (4, 16, 10, 10, 10, 10, 9)


def versions() -> dict[str, str]:
    """Of boxplus, Python and what computes."""
    import boxplus

    libraries = {name: version(name) for name in ("numpy", "numba", "scipy")}
    return {"boxplus": boxplus.__version__, "python": platform.python_version(), **libraries}


def summary_of(
    solution: Solution,
    config: Any,
    loss: Loss | None,
    stopped: bool,
    reading: Mapping[str, object] = MappingProxyType({}),
    **own: Any,
) -> OptimizationSummary:
    """The summary of a run: what a solution and its settings say, and what is the command's own.

    Args:
        config: a model of settings with those of the solver in `solver`.
        stopped: by the user.
        reading: settings of how the file was read.
        own: the other fields; they win.
    """
    from boxplus.runs.optimization_summary import OptimizationSummary, iteration_facts

    state, reason = state_and_reason(solution, stopped)
    settings = {**config.model_dump(exclude={"solver"}), **config.solver.model_dump(), **reading}
    facts = {
        "versions": versions(),
        "state": state,
        "settings": {**settings, "loss": repr(loss) if loss else "none"},
        "status": solution.status,
        "reason": reason,
        "method": solution.method,
        "linear_solver": solution.linear_solver,
        "cost_initial": solution.cost_initial,
        "cost": solution.cost,
        "invalid": solution.invalid,
        "timing_s": solution.timing_s,
        "history": iteration_facts(solution),
    }
    return OptimizationSummary(**{**facts, **own})


class OptimizationTerminal(Terminal):
    """Prints the same on a terminal and in a pipe but for the colours and the wrapping."""

    stopping = "stopping after this step"

    def __init__(self, *, quiet: bool = False, as_json: bool = False) -> None:
        super().__init__(quiet=quiet, as_json=as_json)
        self._last: float | None = None

    def facts(self, title: str, described: str, loss: Loss | None) -> None:
        """The name of the file in bold, what is in it, and the loss."""
        self.console.print(Text(title, "bold"), soft_wrap=True)
        self.print_rows([("input", described), ("loss", "none" if loss is None else repr(loss))])

    @contextmanager
    def steps(self, method: MethodChoice, should_stop: Callable[[], bool]) -> Iterator[Callable[[Iteration], bool]]:
        """Prints the head of the table; yields what `Problem.solve` calls for every step."""
        from boxplus._jit import on_compilation

        parameter = {MethodChoice.levenberg_marquardt: "λ", MethodChoice.dogleg: "radius"}.get(method, "length")
        compiling = False

        def note_compilation(kernel: str) -> None:
            nonlocal compiling
            if not compiling:
                compiling = True
                self.console.print("compiling kernels (first use only) …")

        purpose, number, solves, adjusted = "", -1, 0, False
        head: list[str] | None = ["step", "cost", "change", "gradient", "largest δ", parameter, "time [s]"]

        def show(iteration: Iteration) -> bool:
            nonlocal head, purpose, number, solves, adjusted
            if head is not None:
                self._row(head, "bold")
                head = None
            if iteration.purpose != purpose:
                purpose, number, solves = iteration.purpose, -1, 0
                self.console.print(Text(_title(purpose, adjusted), "bold"), soft_wrap=True)
            if iteration.number <= number:  # the next of several solves for one purpose
                solves += 1
                self.console.print(Text(f"{_title(purpose, adjusted)}, solve {solves + 1}", "bold"), soft_wrap=True)
            if iteration.number == 0:
                self._last = None
            number, adjusted = iteration.number, adjusted or not purpose
            change = "" if self._last is None else f"{iteration.cost - self._last:.2e}"
            style = ""
            if not iteration.accepted:
                change, style = "rejected", "yellow"
            moved = f"{iteration.step:.2e}" if iteration.number else ""
            cells = [str(iteration.number), f"{iteration.cost:.9e}", change, f"{iteration.gradient:.2e}", moved]
            self._row([*cells, f"{iteration.parameter:.1e}", f"{iteration.time_s:.3f}"], style)
            self._last = iteration.cost
            return should_stop()

        with on_compilation(note_compilation):
            yield show

    def _row(self, cells: list[str], style: str) -> None:
        line = " ".join(cell.rjust(width) for cell, width in zip(cells, _WIDTHS, strict=True))
        self.console.print(Text(line, style), soft_wrap=True)

    def conclude(self, summary: OptimizationSummary, unit: str, folder: Path, files: list[str], outcome: Outcome) -> None:
        """Write `run.json`, and say why it stopped, errors before and after, notes and files.

        Args:
            unit: of the errors.
            folder: of the results. files: in it, those that may be there.
            outcome: to be filled in.
        """
        summary.write(folder / "run.json")
        good = summary.status == "converged" and summary.state == "finished" and summary.doubt is None
        ended = Text(f"{summary.status}: {summary.reason}", "green" if good else "yellow")
        (self.console if good else self.alarms).print(ended, soft_wrap=True)
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
        for heading in (f"error [{unit}]", "rms", "median", "99th perc.", "largest", "not valid"):
            table.add_column(Text(heading), justify="left" if heading.startswith("error") else "right")
        for name, errors in (("before", summary.errors_initial), ("after", summary.errors)):
            values = (errors.rms, errors.median, errors.p99, errors.largest)
            table.add_row(name, *(f"{value:.4g}" for value in values), str(errors.invalid))
        self.console.print(table)
        last = f" ({_LAST})" if summary.is_last_of_several else ""
        rows = {"cost": f"{summary.cost_initial:.9e} → {summary.cost:.9e}{last}"}
        if summary.chi2 is not None and summary.chi2_initial is not None:
            rows["χ²"] = f"{summary.chi2_initial:.6f} → {summary.chi2:.6f} (without ½ and without robust loss)"
        rows |= {
            "start": summary.start,
            "method": summary.method,
            "linear solver": summary.linear_solver,
            "summed": summary.convention,
        }
        own = (("fit", summary.fit), ("loop closures", summary.loops), ("optimality", summary.certificate))
        rows |= {name: text for name, text in own if text}
        self.print_rows(rows.items())
        for note in summary.notes:
            self.warn(note)
        if summary.doubt is not None:
            self.doubt(summary.doubt)
        self.print_files(folder, [*files, "run.json"])
        outcome.end(summary, summary.state, untrusted=summary.doubt is not None)


def _title(purpose: str, adjusted: bool) -> str:
    """What stands above the steps of a solve, where there are several."""
    if purpose:
        return f"examining the result: {purpose}" if purpose.endswith("?") else purpose
    return "adjusting again" if adjusted else "adjusting"


def state_and_reason(solution: Solution, stopped: bool) -> tuple[Literal["finished", "interrupted"], str]:
    """Whether it was Ctrl-C that ended it, and why it stopped."""
    if stopped and solution.status == "stopped":
        return "interrupted", f"interrupted after step {solution.iterations}; everything up to there is written"
    return "finished", solution.reason
