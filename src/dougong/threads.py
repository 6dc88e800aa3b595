"""How many threads the kernels use, and the one way they are fanned out.

Kernels are serial and release the GIL; they run over fixed blocks on a thread pool. The blocks
do not depend on the thread count, so neither does any result, and Ctrl-C works between blocks.
"""

import os
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar, cast

Item = TypeVar("Item")

_threads = max(
    1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
)


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
    if _threads == 1 or len(starts) <= 1:
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
