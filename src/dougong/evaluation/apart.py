"""A measurement in a process of its own: what others before it left in memory does not count."""

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def apart(work: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Return ``work(*args, **kwargs)`` as a new process, started for it alone, answers it.

    The function is one of a module; what it is given and returns is pickled.

    Raises
    ------
    concurrent.futures.process.BrokenProcessPool
        The process was killed, or crashed. Whatever `work` raises is raised as it is.
    """
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(work, *args, **kwargs).result()
