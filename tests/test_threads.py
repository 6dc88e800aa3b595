"""Blocks are fanned out whole, in fixed pieces, and errors come back."""

import threading
import time

import pytest

from dougong import threads


@pytest.fixture(params=[1, 3])
def workers(request):
    before = threads.get_threads()
    threads.set_threads(request.param)
    yield request.param
    threads.set_threads(before)


def test_items_made_ahead_come_in_order(workers):
    assert list(threads.ahead(iter(range(50)))) == list(range(50))
    assert list(threads.ahead([])) == []


def test_an_error_of_the_source_is_raised_behind_what_came_before_it(workers):
    def source():
        yield 1
        raise ZeroDivisionError

    items = threads.ahead(source())
    assert next(items) == 1
    with pytest.raises(ZeroDivisionError):
        next(items)


def test_whoever_stops_early_lets_the_source_close_its_files(workers):
    closed = []

    def source():
        try:
            yield from range(50)
        finally:
            closed.append(True)

    items = threads.ahead(source())
    assert next(items) == 0
    items.close()
    assert closed == [True]


def test_the_next_item_is_made_while_one_is_used():
    before = threads.get_threads()
    threads.set_threads(2)
    is_made = threading.Event()

    def source():
        yield "first"
        is_made.set()
        yield "second"

    try:
        for item in threads.ahead(source()):
            assert is_made.wait(10.0), item
    finally:
        threads.set_threads(before)


def test_each_of_many_jobs_is_done_and_comes_in_order(workers):
    assert threads.each(lambda item: 2 * item, range(50)) == list(range(0, 100, 2))
    assert threads.each(lambda item: item, []) == []


def test_an_error_of_one_of_many_jobs_is_raised(workers):
    with pytest.raises(ZeroDivisionError):
        threads.each(lambda item: 1 / (item - 7), range(50))


@pytest.mark.parametrize("jobs", [1, 2, 3, 8])
def test_jobs_share_the_threads_and_never_use_more(workers, jobs):
    """Each of two jobs had as many threads as there are, for itself."""
    lock, now, most = threading.Lock(), 0, 0

    def block(*_):
        nonlocal now, most
        with lock:
            now += 1
            most = max(most, now)
        time.sleep(0.002)
        with lock:
            now -= 1

    threads.each(lambda _: threads.for_blocks(6, 1, block), range(jobs))
    assert 1 <= most <= workers
    seen = set()
    threads.for_blocks(6, 1, lambda *_: seen.add(threading.get_ident()))
    assert (threading.get_ident() in seen) == (workers == 1), "who fanned out is as free as before"


def test_many_jobs_run_at_the_same_time():
    before = threads.get_threads()
    threads.set_threads(2)
    both = threading.Barrier(2)
    try:
        threads.each(lambda _: both.wait(10.0), range(2))
    finally:
        threads.set_threads(before)


@pytest.mark.parametrize("count", [0, 1, 7, 100])
@pytest.mark.parametrize("workers", [1, 3])
def test_every_index_is_visited_once(count, workers):
    before = threads.get_threads()
    threads.set_threads(workers)
    try:
        seen: list[range] = []
        threads.for_blocks(count, 7, lambda start, stop: seen.append(range(start, stop)))
    finally:
        threads.set_threads(before)
    assert sorted(index for block in seen for index in block) == list(range(count))
    assert all(len(block) <= 7 for block in seen)


@pytest.mark.parametrize("workers", [1, 3])
def test_an_error_in_a_block_is_raised(workers):
    def fail(start: int, stop: int) -> None:
        if start == 14:
            raise ZeroDivisionError

    before = threads.get_threads()
    threads.set_threads(workers)
    try:
        with pytest.raises(ZeroDivisionError):
            threads.for_blocks(100, 7, fail)
    finally:
        threads.set_threads(before)
