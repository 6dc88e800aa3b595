"""How many threads are used, and the ways that work is fanned out to them.

Kernels are serial and release the GIL; they run over fixed blocks on a thread pool. The blocks
do not depend on the thread count, so neither does any result, and Ctrl-C works between blocks.
Jobs of Python that are too small for blocks, and many, run side by side (`each`).
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
"""Of each thread: its share of the threads, where it is one of those of `each`."""


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
    starts, threads = range(0, count, block), _own_threads()
    if threads == 1 or len(starts) <= 1:
        for start in starts:
            task(start, min(start + block, count))
        return
    with ThreadPoolExecutor(threads) as pool:
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
    The jobs share the threads: what one cuts into blocks goes to its own share. The first exception
    is raised; jobs not started by then are dropped, and those that run come to their end.
    """
    todo, threads = list(items), _own_threads()
    at_once = min(threads, len(todo))
    if at_once <= 1:
        return [do(item) for item in todo]
    share = threads // at_once
    with ThreadPoolExecutor(at_once, initializer=_take_share, initargs=(share,)) as pool:
        futures = [pool.submit(do, item) for item in todo]
        try:
            return [future.result() for future in futures]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _own_threads() -> int:
    """Return how many threads the thread that asks may use: all, or its share in `each`."""
    return getattr(_here, "share", _threads)


def _take_share(share: int) -> None:
    _here.share = share


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
