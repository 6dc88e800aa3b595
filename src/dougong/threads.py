"""How many threads the kernels use, and the one way they are fanned out.

Kernels are serial and release the GIL; they run over fixed blocks on a thread pool. The blocks
do not depend on the thread count, so neither does any result, and Ctrl-C works between blocks.
"""

import os
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar, cast

Item = TypeVar("Item")
Made = TypeVar("Made")

_threads = max(
    1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
)


_here = threading.local()
"""Of each thread: whether it is one of those of `each`, which fan out nothing further."""


def set_threads(count: int) -> None:
    """Use `count` threads from now on (``--threads``); also caps OpenCV's."""
    global _threads
    _threads = max(1, int(count))


def get_threads() -> int:
    """Return the number of threads in use."""
    return _threads


def for_blocks(count: int, block: int, task: Callable[[int, int], None]) -> None:
    """Call ``task(start, stop)`` over ``range(count)`` in blocks of `block`, on the threads.

    The first exception is raised; blocks not started by then are dropped.
    """
    starts = range(0, count, block)
    if _threads == 1 or len(starts) <= 1 or getattr(_here, "is_one_of_many", False):
        for start in starts:
            task(start, min(start + block, count))
        return
    with ThreadPoolExecutor(_threads) as pool:
        futures = [pool.submit(task, start, min(start + block, count)) for start in starts]
        try:
            for future in futures:
                future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def each(do: Callable[[Item], Made], items: Iterable[Item]) -> list[Made]:
    """Return ``do(item)`` of all items, in their order, several at a time on the threads.

    For jobs that spend much of their time outside of blocks: a pose's fit, a cloud's description.
    What they cut into blocks stays in their thread where there are jobs for all threads. The first
    exception is raised; jobs not started by then are dropped.
    """
    todo = list(items)
    if _threads == 1 or len(todo) <= 1 or getattr(_here, "is_one_of_many", False):
        return [do(item) for item in todo]
    start = _be_one_of_many if len(todo) >= _threads else None
    with ThreadPoolExecutor(_threads, initializer=start) as pool:
        futures = [pool.submit(do, item) for item in todo]
        try:
            return [future.result() for future in futures]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _be_one_of_many() -> None:
    _here.is_one_of_many = True


def ahead(items: Iterable[Item]) -> Iterator[Item]:
    """Yield `items`, each made in another thread while its predecessor is used.

    One more item is held. With one thread they are made as they are asked for.
    """
    source = iter(items)
    if _threads == 1:
        yield from source
        return
    end = object()
    with ThreadPoolExecutor(1) as worker:
        try:
            coming = worker.submit(next, source, cast(Item, end))
            while (item := coming.result()) is not end:
                coming = worker.submit(next, source, cast(Item, end))
                yield item
        finally:
            # Whoever stops early lets the source close its files, in the thread that runs it.
            if isinstance(source, Generator):
                worker.submit(source.close).result()
