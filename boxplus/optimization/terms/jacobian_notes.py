"""What a solution says of its Jacobians: which are differences, which jump where it began or ended, and which are wrong.

A search ends where the gradient that the Jacobians give vanishes. Where these are a user's and wrong, that is no minimum, and
looks like one. So they are compared with differences where it ended, of some residuals and in one direction of chance, which is
enough: those that a mistake does not show in have no volume.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.terms.group import Group
from boxplus.residuals.residual import Residual

_LISTED = 5
_LOOKED_AT, _RUN = 64, 16  # residuals that are compared, so many in a row
_STEPS = (1e-3, 1e-4, 1e-5, 1e-6)  # of differences; two that agree are right
_SMOOTH, _WRONG = 1e-3, 1e-2  # of their size, by which these agree, and by which a Jacobian does not
_ROUNDING = 1e-13  # of the residuals, over the step, that differences are not known better than


def jacobian_notes(
    groups: Sequence[Group], start: Sequence[NDArray[np.float64]], end: Sequence[NDArray[np.float64]]
) -> tuple[str, ...]:
    """Sentences on the Jacobians of each group, between values of all blocks at the start and at the end."""
    notes = [f"{group.name}: {group.residual.jacobian_note}" for group in groups if group.residual.jacobian_note]
    for group in groups:
        for values, where, advice in (
            (start, "began", "which way they turned back was arbitrary: another start may end elsewhere"),
            (end, "ended", "their gradient jumps there: wrong measurements, or a start that was too far off"),
        ):
            rows = np.flatnonzero(group.half_turned(values))
            if len(rows):
                listed = ", ".join(map(str, rows[:_LISTED])) + (" …" if len(rows) > _LISTED else "")
                notes.append(f"{len(rows)} of the residuals of {group.name} ({listed}) {where} half a turn off, {advice}")
    return (*notes, *wrong_jacobians(groups, end))


def wrong_jacobians(groups: Sequence[Group], values: Sequence[NDArray[np.float64]]) -> tuple[str, ...]:
    """A sentence for every group whose Jacobians are somebody's own and contradict differences at values of all blocks."""
    return tuple(note for group in groups if _is_foreign(group.residual) for note in _contradictions(group, values))


def _is_foreign(residual: Residual) -> bool:
    """Whether its Jacobians are somebody's own."""
    # A `UserResidual` says it; the compiler of users' functions is not imported where there is none.
    kind = getattr(residual, "jacobian_kind", None)
    return kind == "analytic" if kind is not None else type(residual).__module__.partition(".")[0] != "boxplus"


def _contradictions(group: Group, values: Sequence[NDArray[np.float64]]) -> list[str]:
    """A sentence where Jacobians contradict differences."""
    residual, count = group.residual, group.residual.count
    rng = np.random.default_rng(0)
    x = tuple(values[c.block.number] for c in group.connections)
    rows = tuple(np.ascontiguousarray(c.rows, dtype=np.uint32) for c in group.connections)
    way = {
        c.block.number: rng.uniform(0.5, 1.0, (len(v), m.dof))
        for c, v, m in zip(group.connections, x, residual.manifolds, strict=True)
    }
    runs = max(1, min(_LOOKED_AT // _RUN, count // _RUN))
    begins = np.unique(np.linspace(0, max(count - _RUN, 0), runs).astype(int))
    chosen = np.unique(np.concatenate([np.arange(b, min(b + _RUN, count)) for b in begins]))
    J = tuple(np.zeros((count, residual.dim, m.dof)) for m in residual.manifolds)
    r, valid = np.zeros((count, residual.dim)), np.zeros(count, dtype=np.bool_)

    def evaluate(step: float) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Residuals of those chosen with all variables moved along the way."""
        parts = zip(group.connections, x, residual.manifolds, strict=True)
        moved = tuple(np.ascontiguousarray(m.boxplus(v, step * way[c.block.number])) for c, v, m in parts)
        e, known = np.zeros_like(r), np.zeros(count, dtype=np.bool_)
        for begin in begins:
            residual.evaluate_into(int(begin), min(int(begin) + _RUN, count), moved, rows, e, known)
        return e[chosen], known[chosen]

    for begin in begins:
        residual.linearize_into(int(begin), min(int(begin) + _RUN, count), x, rows, r, J, valid)
    said = sum(
        np.einsum("nab,nb->na", own[chosen], way[c.block.number][at[chosen]])
        for own, c, at in zip(J, group.connections, rows, strict=True)
    )
    usable = valid[chosen] if group.removed is None else valid[chosen] & ~group.removed[chosen]
    is_wrong, worst, before = np.zeros(len(chosen), dtype=np.bool_), 0.0, None
    for step in _STEPS:
        (ahead, one), (behind, other) = evaluate(step), evaluate(-step)
        found = (ahead - behind) / (2.0 * step)
        usable &= one & other
        if before is not None:
            size = np.maximum(np.linalg.norm(found, axis=1), np.linalg.norm(said, axis=1))
            known = usable & (size > _ROUNDING / step * (1.0 + np.abs(r[chosen]).max(axis=1)) / _SMOOTH)
            off = np.linalg.norm(found - said, axis=1)
            bad = known & (np.linalg.norm(found - before, axis=1) <= _SMOOTH * size) & (off > _WRONG * size)
            is_wrong |= bad
            worst = max(worst, float((off[bad] / size[bad]).max(initial=0.0)))
        before = found
    if not is_wrong.any():
        return []
    return [
        f"{group.name}: the Jacobians of {np.count_nonzero(is_wrong)} of {len(chosen)} residuals that were looked at contradict "
        f"differences of these, by up to {worst:.0%}: where the search ended need be no minimum, and standard deviations are "
        "wrong; see check_jacobian"
    ]
