"""`--gt`: a run compared with the ground truth at its end."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from boxplus.errors import BoxplusError

if TYPE_CHECKING:
    from boxplus.evaluation.alignment import AlignmentKind
    from boxplus.formats.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class Comparison:
    """A run beside the ground truth.

    Attributes:
        line: for the terminal.
        evaluation: as in `evaluation.json`; None where the two cannot be compared.
        error: why not, or why that file could not be written.
    """

    line: str
    evaluation: Mapping[str, Any] | None = None
    error: str | None = None

    @property
    def row(self) -> tuple[str, str]:
        """Of the results on the terminal."""
        return "against --gt", self.line


def read_ground_truth(path: Path | None) -> Trajectory | None:
    """The trajectory to compare with, read before a run: a file that cannot be used is better refused then.

    Raises:
        InputError: it cannot be read, or has no times.
    """
    from boxplus.formats.trajectory import read_trajectory

    if path is None:
        return None
    truth = read_trajectory(path)
    truth.times  # noqa: B018 - refuses a file without them
    return truth


def compare_with(truth: Trajectory, estimate: Path, evaluation: Path, alignment: AlignmentKind) -> Comparison:
    """Write `evaluation.json`. Where that is not possible the run is as good as without it: nothing is raised.

    A straight drive does not determine the rotation about it: such a run is compared from its first pose on, which is said.

    Args:
        estimate: the trajectory that a run wrote.
        evaluation: the file to write.
        alignment: of the estimate onto the ground truth: what the estimator leaves open.
    """
    from boxplus.cli.terminal.own_words import EVALUATION, evaluation_in_options, in_options
    from boxplus.evaluation.alignment import UndeterminedAlignmentError
    from boxplus.evaluation.evaluation import evaluate
    from boxplus.formats.output import atomic_file
    from boxplus.formats.trajectory import read_trajectory

    try:
        poses = read_trajectory(estimate)
        try:
            found = evaluate(poses, truth, alignment=alignment, method="interpolate")
        except UndeterminedAlignmentError as error:
            if alignment not in ("se3", "yaw"):  # from one pose no scale is known
                raise
            found = evaluate(poses, truth, alignment="origin", method="interpolate")
            undetermined = f"compared from the first pose on, not by all positions: expected {error.expected} – got {error.got}"
            found = replace(found, warnings=(*found.warnings, undetermined))
        found = evaluation_in_options(found)
        figures = found.to_dict()
        with atomic_file(evaluation) as file:
            file.write(f"{json.dumps(figures, indent=2)}\n".encode())
    except BoxplusError as error:
        return Comparison("not compared, see the error", error=in_options(str(error), EVALUATION))
    return Comparison(f"{found.title}: {found.ate.line('m')}", figures)
