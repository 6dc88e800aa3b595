"""Shared fixtures: the folder of real scans."""

import os
import signal
from pathlib import Path

import pytest

DATA = Path(os.environ.get("DOUGONG_TEST_DATA", Path(__file__).parents[2] / "shared" / "data"))

# A shell that starts the tests in the background lets them, and all they start, ignore Ctrl-C.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def data() -> Path:
    """Return the folder of real scans, or skip and say where it was looked for."""
    if not DATA.is_dir():
        pytest.skip(f"no real scans at {DATA}; set DOUGONG_TEST_DATA")
    return DATA
