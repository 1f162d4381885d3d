"""The only door to Ray, which is in the extra `fleet`."""

from __future__ import annotations

import importlib
from typing import Any

from boxplus.errors import InputError


def ray(purpose: str) -> Any:
    """The module ray.

    Args:
        purpose: what it does for the caller, as a clause: `which runs tasks on many machines`.

    Raises:
        InputError: it is not installed; the message names the extra.
    """
    try:
        return importlib.import_module("ray")
    except ImportError:
        raise InputError(f"Ray, {purpose}", "it is not installed", "pip install 'boxplus[fleet]'") from None
