"""Who runs the tasks: any `concurrent.futures.Executor`, here or on other machines.

A task writes one file and returns a small record. A task whose file is there is finished and not
run again; one that fails is tried once more, then named, and the others go on.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dougong.errors import DougongError, OutputError, TileError
from dougong.tiles.cloud import Arrays, Record, read_record, write_arrays

_TRIES = 2


@dataclass(frozen=True, slots=True)
class Task:
    """Work on one tile; everything in it travels to whoever does it."""

    tile: str
    done: Path
    """The file that it writes, last and whole: where it is, the task is finished."""
    work: Callable[[Any], tuple[Arrays, Record]]
    """A function of a module, so that another process can import it."""
    job: Any


def perform(task: Task) -> Record:
    """Do a task and return its record."""
    known = read_record(task.done)
    if known is not None:
        return known
    arrays, record = task.work(task.job)
    write_arrays(task.done, arrays, record)
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
        waiting: list[tuple[int, int]] = []
        for number, task in reversed(list(enumerate(tasks))):
            known = read_record(task.done)
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
                elif tried < _TRIES and not isinstance(error, OutputError):
                    waiting.append((number, tried + 1))
                else:
                    failed[number] = error
        if failed:
            raise _told(failed, tasks)
        return [records[number] for number in range(len(tasks))]


def _told(failed: dict[int, BaseException], tasks: Sequence[Task]) -> DougongError:
    first = failed[min(failed)]
    if isinstance(first, OutputError):
        return first
    names = ", ".join(tasks[number].tile for number in sorted(failed)[:5])
    error = TileError(
        f"{len(failed)} of {len(tasks)} tiles failed twice ({names}): {first!r}. The others are "
        "done: with --work the same command goes on with these."
    )
    error.__cause__ = first
    return error


@contextmanager
def local_engine() -> Iterator[Engine]:
    """Yield the embedded engine: one tile at a time, whose kernels use all threads."""
    with ThreadPoolExecutor(1) as executor:
        yield Engine(executor, 1)
