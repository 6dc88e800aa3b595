"""Who runs the tasks: any `concurrent.futures.Executor`, here or on other machines.

A task writes one file and returns a small record. A task whose file is there is finished and not
run again; one that fails is tried once more, then named, and the others go on.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from dougong.errors import DougongError, InputError, OutputError, TileError
from dougong.threads import get_threads
from dougong.tiles.cloud import Arrays, Record, read_record, write_arrays
from dougong.tiles.folder import Folder

_TRIES = 2


@dataclass(frozen=True, slots=True)
class Task:
    """Work on one tile; everything in it travels to whoever does it."""

    tile: str
    folder: Folder
    done: str
    """The file that it writes, last and whole: where it is, the task is finished."""
    work: Callable[[Any], tuple[Arrays, Record]]
    """A function of a module, so that another process can import it."""
    job: Any


def perform(task: Task) -> Record:
    """Do a task and return its record."""
    known = read_record(task.folder, task.done)
    if known is not None:
        return known
    arrays, record = task.work(task.job)
    write_arrays(task.folder, task.done, arrays, record)
    return record


@dataclass(frozen=True, slots=True)
class Engine:
    """An executor and how many tasks it is given at a time: memory is what they need together."""

    executor: Executor
    width: int

    def run(self, tasks: Sequence[Task]) -> list[Record]:
        """Do all tasks and return their records, in order.

        Raises
        ------
        TileError
            Some failed twice; the others are done and kept.
        """
        records: dict[int, Record] = {}
        there = {name for folder in {task.folder for task in tasks} for name in folder.names()}
        waiting: list[tuple[int, int]] = []
        for number, task in reversed(list(enumerate(tasks))):
            known = read_record(task.folder, task.done) if task.done in there else None
            if known is None:
                waiting.append((number, 1))
            else:
                records[number] = known
        failed: dict[int, BaseException] = {}
        running: dict[Future[Record], tuple[int, int]] = {}
        while waiting or running:
            while waiting and len(running) < self.width:
                number, tried = waiting.pop()
                running[self.executor.submit(perform, tasks[number])] = (number, tried)
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                number, tried = running.pop(future)
                error = future.exception()
                if error is None:
                    records[number] = future.result()
                elif isinstance(error, OutputError):
                    # The disk is full or the storage away: it is for the others too.
                    failed[number] = error
                    waiting.clear()
                elif tried < _TRIES:
                    waiting.append((number, tried + 1))
                else:
                    failed[number] = error
        if failed:
            raise _told(failed, tasks)
        return [records[number] for number in range(len(tasks))]


def _told(failed: dict[int, BaseException], tasks: Sequence[Task]) -> DougongError:
    first = failed[min(failed)]
    for error in failed.values():
        if isinstance(error, OutputError):
            return error
    names = ", ".join(tasks[number].tile for number in sorted(failed)[:5])
    more = ""
    if isinstance(first, FileNotFoundError):
        more = f"Every worker must see {tasks[0].folder}: mount it there, or use --work s3://. "
    error = TileError(
        f"{len(failed)} of {len(tasks)} tiles failed twice ({names}): {first!r}. {more}The others "
        "are done: with --work the same command goes on with these."
    )
    error.__cause__ = first
    return error


_name = "local"


def set_engine(name: str) -> None:
    """Use an engine from now on (``--engine``): local, dask or dask://HOST:PORT.

    Raises
    ------
    InputError
        There is no such engine, or Dask is not installed.
    """
    global _name
    if name != "local" and name != "dask" and not re.fullmatch(r"dask://[^/\s]+:\d+", name):
        msg = f"--engine knows local, dask and dask://HOST:PORT, got {name!r}. Choose one of these."
        raise InputError(msg)
    if name != "local" and find_spec("distributed") is None:
        msg = f"--engine {name} needs Dask, which is not here: pip install 'dougong[dask]'."
        raise InputError(msg)
    _name = name


@contextmanager
def engine_in_use() -> Iterator[Engine]:
    """Yield the engine that was asked for."""
    if _name == "local":
        with local_engine() as engine:
            yield engine
        return
    from dougong.tiles.cluster import executor_of

    with executor_of(_name) as (executor, width):
        yield Engine(executor, width)


@contextmanager
def local_engine() -> Iterator[Engine]:
    """Yield the embedded engine: two tiles at a time, whose kernels share the threads.

    What is serial about a tile (reading, halos, writing) goes on beside the other one's kernels.
    """
    width = min(2, get_threads())
    with ThreadPoolExecutor(width) as executor:
        yield Engine(executor, width)
