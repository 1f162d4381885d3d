"""Steps of solves beside the one of the result, shown under a name: whoever sees them can tell them apart."""

from __future__ import annotations

from dataclasses import replace

from boxplus.optimization.minimizers.minimize import Callback


def named(callback: Callback | None, purpose: str) -> Callback | None:
    """The callback of a solve with this purpose; one that has a purpose already keeps it."""
    if callback is None:
        return None
    return lambda step: bool(callback(step if step.purpose else replace(step, purpose=purpose)))
