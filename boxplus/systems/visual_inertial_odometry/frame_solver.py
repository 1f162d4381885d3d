"""The solver of a window that is solved again with every frame: few steps, from where the frame before ended.

A tilt of the whole window against the accelerometer's bias is 1e-8 of what the IMU knows from frame to frame, and decides where
it goes: Levenberg and Marquardt's damping has to be tiny, or it holds the window where it is, while the covariance says it is
known. But the valley is curved: at a tilt of 3 hundredths velocities bend by millimetres a second, many standard deviations of
a good IMU, and full steps along it raise the cost. So the damping that was needed is remembered, a tenth of it from solve to
solve, and where no step was taken the solver tries again from where the damping had come to. With a new beginning at every
frame all steps of three seconds were refused, and the poses were the IMU's alone.
"""

from __future__ import annotations

from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution

_LEAST_DAMPING = 1e-10
_RELAXED = 0.1  # of the damping of one frame, for the next one
_RAISED = 16.0  # what four refusals in a row come to is raised by this for the next
_TRIES = 4
# A step that is hardly expected to lower the cost is left to the next frame, which begins there.
_COST_TOLERANCE, _EXPECTED_TOLERANCE = 1e-3, 3e-3


class FrameSolver:
    """Minimises a problem again and again as it grows and shrinks."""

    def __init__(self) -> None:
        self._damping = _LEAST_DAMPING

    def solve(self, problem: Problem, steps: int) -> Solution:
        """The minimum, as far as so many steps lead to it; more of them only where none was taken."""
        solution = self._once(problem, steps, _COST_TOLERANCE, _EXPECTED_TOLERANCE)
        for _ in range(_TRIES - 1):
            tried = solution.history[1:]
            if not tried or any(step.accepted for step in tried):
                break
            self._damping = _RAISED * tried[-1].parameter
            solution = self._once(problem, steps, 0.0, 0.0)  # what is damped that much is not expected to lower the cost by much
        taken = [step.parameter for step in solution.history[1:] if step.accepted]
        self._damping = max(_RELAXED * (taken[-1] if taken else self._damping), _LEAST_DAMPING)
        return solution

    def _once(self, problem: Problem, steps: int, cost_tolerance: float, expected_tolerance: float) -> Solution:
        return problem.solve(
            max_iterations=steps,
            cost_tolerance=cost_tolerance,
            expected_tolerance=expected_tolerance,
            initial_damping=self._damping,
            examine=False,
        )
