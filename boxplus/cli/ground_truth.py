"""`--gt`: a run compared with the ground truth at its end."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from boxplus.evaluation.alignment import AlignmentKind
    from boxplus.formats.trajectory import Trajectory


def compare_with(truth: Trajectory, estimate: Path, evaluation: Path, alignment: AlignmentKind) -> str:
    """Write `evaluation.json`; returns its main line.

    Args:
        estimate: the trajectory that a run wrote.
        evaluation: the file to write.
        alignment: of the estimate onto the ground truth: what the estimator leaves open.

    Raises:
        InputError: the two do not overlap in time, or their comparison means nothing.
        OutputError: the file cannot be written.
    """
    from boxplus.evaluation.evaluation import evaluate
    from boxplus.formats.output import atomic_file
    from boxplus.formats.trajectory import read_trajectory

    found = evaluate(read_trajectory(estimate), truth, alignment=alignment, method="interpolate")
    with atomic_file(evaluation) as file:
        file.write(f"{json.dumps(found.to_dict(), indent=2)}\n".encode())
    return f"{found.title}: {found.ate.line('m')}"
