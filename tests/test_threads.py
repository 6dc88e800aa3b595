"""Blocks are fanned out whole, in fixed pieces, and errors come back."""

import pytest

from dougong import threads


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
