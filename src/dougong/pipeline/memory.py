"""``--memory``: a job that cannot fit is refused before it starts."""

from collections.abc import Iterable
from pathlib import Path

from dougong.errors import InputError
from dougong.formats import describe

# Rounded up from measured peaks: a demo (1.0e6 + 0.6e6 points) 1.08 GB, the lidar recipe on 3e6
# points 0.83 GB. Base: libraries and the thinned clouds of the registration; per point of the
# largest cloud: records, coordinates, neighbours; of those that wait: records, coordinates.
BASE_BYTES = 800_000_000
BYTES_PER_POINT = 230
BYTES_PER_WAITING_POINT = 110


def estimated_bytes(points: Iterable[int]) -> int:
    """Return the memory a job needs that works on clouds of `points` in turn and keeps them."""
    counts = sorted(points, reverse=True)
    if not counts:
        return BASE_BYTES
    return BASE_BYTES + counts[0] * BYTES_PER_POINT + sum(counts[1:]) * BYTES_PER_WAITING_POINT


def refuse_too_large(files: Iterable[Path], memory_bytes: int | None) -> None:
    """Refuse a job whose estimated need exceeds ``--memory``.

    Raises
    ------
    InputError
        It does.
    """
    if memory_bytes is None:
        return
    points = [describe(file).points for file in files]
    need = estimated_bytes(points)
    if need > memory_bytes:
        msg = (
            f"{sum(points):,} points need about {need / 1e9:.1f} GB, more than --memory "
            f"{memory_bytes / 1e9:.1f} GB. Raise it, or decimate the clouds first."
        )
        raise InputError(msg)
