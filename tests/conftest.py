"""Fixtures that every test may use."""

from pathlib import Path

import pytest
from hypothesis import settings

# The first call of a kernel compiles it, so a single example may take seconds; the same examples run every time.
settings.register_profile("boxplus", deadline=None, derandomize=True)
settings.load_profile("boxplus")

SHARED_DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings beside the repository; tests that need it skip where it is missing."""
    if not SHARED_DATA.is_dir():
        pytest.skip("the recordings in shared/data are not on this machine")
    return SHARED_DATA
