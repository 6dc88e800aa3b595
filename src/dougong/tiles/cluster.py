"""A Dask cluster as an engine: the one that is named, or processes of this machine."""

import logging
import shutil
from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from distributed import Client, LocalCluster, WorkerPlugin

import dougong
from dougong.errors import InputError, TileError
from dougong.threads import get_threads, set_threads
from dougong.tiles.shared import keep_copies

_ANSWER_SECONDS = 10
_JOIN_SECONDS = 20
_NAME = "dougong"
_CHATTY = ("distributed.client", "tornado.application")
"""They print a traceback where we say a sentence."""


class _AtWork(WorkerPlugin):  # type: ignore[misc]
    """Sets a worker up, also one that is started later in place of one that died."""

    name = _NAME

    def setup(self, worker: Any) -> None:
        """Use one thread for a tile, and copy what is read from shared storage to the disk."""
        # Several tiles at a time are a worker's parallelism.
        set_threads(1)
        self.copies = Path(worker.local_directory) / "dougong-copies"
        shutil.rmtree(self.copies, ignore_errors=True)
        keep_copies(self.copies)

    def teardown(self, worker: Any) -> None:
        """Delete the copies."""
        del worker
        keep_copies(None)
        shutil.rmtree(self.copies, ignore_errors=True)


@contextmanager
def executor_of(name: str) -> Iterator[tuple[Executor, int]]:
    """Yield who runs tasks, and how many at a time.

    Parameters
    ----------
    name : str
        dask: a process for every thread that may be used. dask://HOST:PORT: a scheduler.

    Raises
    ------
    TileError
        Nobody answers there, no worker has joined, or the scheduler went away.
    InputError
        A worker has another version of this package, or none.
    """
    for logger in _CHATTY:
        logging.getLogger(logger).setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        if name == "dask":
            cluster = LocalCluster(
                n_workers=get_threads(), threads_per_worker=1, dashboard_address=None
            )
            client = stack.enter_context(Client(stack.enter_context(cluster)))
        else:
            client = stack.enter_context(_joined(name))
        _refuse_other_versions(client, name)
        client.register_plugin(_AtWork())
        try:
            yield client.get_executor(), max(1, sum(client.nthreads().values()))
        except CancelledError as error:
            msg = (
                f"--engine {name}: the scheduler went away. Start it and its workers again: with "
                "--work the same command goes on where it was."
            )
            raise TileError(msg) from error
        finally:
            # Where the scheduler is gone, so is this.
            with suppress(OSError, RuntimeError):
                client.unregister_worker_plugin(_NAME)


def _joined(name: str) -> Client:
    """Return a client of a scheduler with at least one worker."""
    address = name.removeprefix("dask://")
    try:
        client = Client(f"tcp://{address}", timeout=_ANSWER_SECONDS)
    except OSError as error:
        msg = (
            f"--engine {name}: no scheduler answers there within {_ANSWER_SECONDS} s. Check the "
            "address, or start one with `dask scheduler`."
        )
        raise TileError(msg) from error
    try:
        client.wait_for_workers(1, timeout=_JOIN_SECONDS)
    except TimeoutError as error:
        client.close()
        msg = (
            f"--engine {name}: the scheduler has no workers. Start some with `dask worker "
            f"{address} --nthreads 1`."
        )
        raise TileError(msg) from error
    return client


def _refuse_other_versions(client: Client, name: str) -> None:
    found = client.run(_version, on_error="return")
    for worker, version in found.items():
        if version != dougong.__version__:
            has = f"has dougong {version}" if isinstance(version, str) else "cannot load dougong"
            msg = (
                f"--engine {name}: worker {worker} {has}, this is {dougong.__version__}. "
                "Install the same version there."
            )
            raise InputError(msg)


def _version() -> str:
    return dougong.__version__
