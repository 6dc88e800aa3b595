"""Shared fixtures: the folder of real scans, and a real S3 server."""

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


@pytest.fixture(scope="session")
def s3_endpoint():
    """Return the address of an S3 server on this machine."""
    running = pytest.importorskip("moto.server").ThreadedMotoServer(
        ip_address="127.0.0.1", port=0, verbose=False
    )
    running.start()
    yield "http://{}:{}".format(*running.get_host_and_port())
    running.stop()


@pytest.fixture
def bucket(s3_endpoint, monkeypatch, request):
    """Return the URL of a new bucket, and what lists the keys in it."""
    s3fs = pytest.importorskip("s3fs")
    from s3_server import as_a_user

    as_a_user(monkeypatch, s3_endpoint)
    name = f"bucket-{abs(hash(request.node.name))}"
    system = s3fs.S3FileSystem(use_listings_cache=False)
    system.mkdir(name)
    yield f"s3://{name}", lambda: sorted(key.partition("/")[2] for key in system.find(name))
    s3fs.S3FileSystem.clear_instance_cache()
