"""Two threads in one object: together where both only read, otherwise refused and not waited for."""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from boxplus import Euclidean, IkdTree, InputError, Problem, residuals
from boxplus._thread_guard import ThreadGuard


@contextmanager
def another_thread(inside: Callable[[Callable[[], None]], object]) -> Iterator[None]:
    """While the block runs, another thread stands still where `inside` calls what it is given."""
    entered, leave = threading.Event(), threading.Event()

    def stand_still() -> None:
        entered.set()
        assert leave.wait(60.0)

    thread = threading.Thread(target=inside, args=(stand_still,))
    thread.start()
    try:
        assert entered.wait(60.0)
        yield
    finally:
        leave.set()
        thread.join()


def _points(stand_still: Callable[[], None]) -> object:
    """An argument that calls `stand_still` when it is read."""

    class Points:
        def __array__(self, dtype: object = None, copy: object = None) -> np.ndarray:
            stand_still()
            return np.zeros((1, 3))

    return Points()


UPDATES: dict[str, Callable[[IkdTree, object], object]] = {
    "build": lambda tree, points: tree.build(points),
    "insert": lambda tree, points: tree.insert(points),
    "delete_points": lambda tree, points: tree.delete_points(points),
    "delete_box": lambda tree, points: tree.delete_box(np.zeros(3), np.asarray(points)[0]),
    "reinsert_box": lambda tree, points: tree.reinsert_box(np.zeros(3), np.asarray(points)[0]),
}
SEARCHES: dict[str, Callable[[IkdTree, object], object]] = {
    "nearest": lambda tree, points: tree.nearest(points, 1),
    "radius_search": lambda tree, points: tree.radius_search(np.asarray(points)[0], 1.0),
    "box_search": lambda tree, points: tree.box_search(np.zeros(3), np.asarray(points)[0]),
}


@pytest.mark.parametrize("second", [*UPDATES, *SEARCHES])
def test_nothing_runs_beside_an_insert(second: str) -> None:
    tree = IkdTree(np.eye(3))
    call = (UPDATES | SEARCHES)[second]
    with (
        another_thread(lambda stand_still: tree.insert(_points(stand_still))),
        pytest.raises(
            InputError, match=rf"expected one thread at a time .* – got {second}\(\) while another thread is in insert"
        ),
    ):
        call(tree, np.ones((1, 3)))
    assert len(tree) == 4
    call(tree, np.ones((1, 3)))  # and afterwards all is well


@pytest.mark.parametrize("second", [*UPDATES, *SEARCHES])
def test_only_searches_run_beside_a_search(second: str) -> None:
    tree = IkdTree(np.eye(3))
    with another_thread(lambda stand_still: tree.nearest(_points(stand_still), 1)):
        if second in SEARCHES:
            SEARCHES[second](tree, np.ones((1, 3)))
        else:
            with pytest.raises(InputError, match=rf"got {second}\(\) while another thread is in nearest"):
                UPDATES[second](tree, np.ones((1, 3)))
    assert len(tree) == 3


def _problem() -> Problem:
    problem = Problem()
    x = problem.add_variables(Euclidean(2), [[1.0, 2.0]])
    problem.add_residuals(residuals.Prior(Euclidean(2), [[0.0, 0.0]], sigma=1.0), x)
    return problem


def test_a_problem_is_solved_by_one_thread_at_a_time() -> None:
    problem = _problem()
    done = []

    def solve(stand_still: Callable[[], None]) -> None:
        done.append(problem.solve(callback=lambda step: stand_still()))

    with another_thread(solve):
        for call in (problem.solve, problem.cost, lambda: problem.add_variables(Euclidean(1), [[0.0]])):
            with pytest.raises(InputError, match=r"one thread at a time in a Problem .* while another thread is in solve\(\)"):
                call()
    assert done[0].status == "converged" and np.allclose(done[0].values[0], 0.0)
    assert problem.solve().status == "converged"


def test_a_callback_may_ask_its_own_problem() -> None:
    problem = _problem()
    costs = []
    problem.solve(callback=lambda step: costs.append(problem.cost()))
    assert len(costs) > 1


def test_a_call_that_failed_is_over() -> None:
    tree = IkdTree()
    with pytest.raises(InputError):
        tree.insert([1.0])
    with another_thread(lambda stand_still: tree.insert(_points(stand_still))):
        pass
    assert len(tree) == 1


def test_nobody_is_in_a_copy() -> None:
    guard = ThreadGuard("Problem")
    guard.enter("solve", changes=True)
    other = copy.deepcopy(guard)
    with another_thread(lambda stand_still: (other.enter("solve", changes=True), stand_still())):
        pass
