"""The modules of the campaigns, which are no packages of the library."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

_FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"


@contextmanager
def campaign_modules(**modules: str) -> Iterator[SimpleNamespace]:
    """Modules of `benchmarks/` under names of one's own; they leave no trace."""
    sys.path.insert(0, str(_FOLDER))
    try:
        yield SimpleNamespace(**{name: importlib.import_module(module) for name, module in modules.items()})
    finally:
        sys.path.remove(str(_FOLDER))
        tops = {module.partition(".")[0] for module in modules.values()}
        for name in [name for name in sys.modules if name.partition(".")[0] in tops]:
            del sys.modules[name]
