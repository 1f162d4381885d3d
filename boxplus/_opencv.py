"""The only door to OpenCV, which is in the extra `vision`."""

from __future__ import annotations

import importlib
from typing import Any

from boxplus.errors import InputError


def opencv(purpose: str, error: type[InputError] = InputError) -> Any:
    """The module cv2.

    Args:
        purpose: what it does for the caller, as a clause: `which follows corners`.
        error: what is raised where it is missing.

    Raises:
        InputError: it is not installed; the message names the extra.
    """
    try:
        return importlib.import_module("cv2")
    except ImportError:
        raise error(f"OpenCV, {purpose}", "it is not installed", "pip install 'boxplus[vision]'") from None
