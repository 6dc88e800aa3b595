"""What every reader shares: opening with clear errors, dropping bad rows, choosing the frame.

Formats that store decimals or floats (E57, PLY, PCD, text) are read in two passes: one finds the
low corner and the decimal step of the whole file, one makes clouds. So a chunk and the whole
file have the same local coordinates, digit by digit, in any order of points.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import FARTHEST, BitField, Cloud, Frame, Records, chosen_rows
from dougong.errors import FormatError
from dougong.formats.units import units_of
from dougong.typing import Mask, Points

MOST_DECIMALS = 6


@contextmanager
def opened(path: Path) -> Iterator[IO[bytes]]:
    """Open a file for reading, or say in one sentence why not.

    Raises
    ------
    FormatError
        Missing, a folder, a pipe or device, not permitted, or empty.
    """
    if path.is_dir():
        raise FormatError(f"{path} is a folder, expected a point cloud file. Name a file in it.")
    if path.exists() and not path.is_file():
        # A pipe can be read once and from its beginning only; opening one may wait for ever.
        msg = f"{path} is a pipe or a device, expected a file on a disk. Write it to one first."
        raise FormatError(msg)
    try:
        file = path.open("rb")
    except FileNotFoundError:
        raise FormatError(f"{path} does not exist. Check the path.") from None
    except PermissionError:
        raise FormatError(f"{path} may not be read by this user. Change its permissions.") from None
    except OSError as error:
        raise FormatError(f"{path} cannot be opened: {error.strerror}.") from error
    with file:
        if not file.read(1):
            raise FormatError(f"{path.name} is empty (0 bytes). Export or copy it again.")
        file.seek(0)
        yield file


def stem_of(path: Path) -> str:
    """Return the name of a cloud: its file's stem, without `.copc` too."""
    return path.stem.removesuffix(".copc")


def unit_notes(frame: Frame) -> tuple[str, ...]:
    """Return in words what was done about units that are not metres."""
    units = units_of(frame.crs)
    if units.is_geographic:
        return (f"in degrees ({units.name}): its x and y are not lengths.",)
    if frame.unit_m == (1.0, 1.0, 1.0):
        return ()
    factors = ", ".join(f"{a} by {f:.10g}" for a, f in zip("xyz", frame.unit_m, strict=True))
    guess = "" if units.has_vertical else " No unit of heights is named: taken as that of x and y."
    if not units.has_vertical and frame.unit_m[2] != frame.unit_m[0]:
        guess = ""
    return (f"not in metres; converted by its reference system ({factors}).{guess}",)


def refuse_empty(count: int, path: Path) -> None:
    """Raise FormatError where a file holds no points."""
    if count == 0:
        msg = f"{path.name} holds no points (its header says 0). Export it again."
        raise FormatError(msg)


@dataclass(slots=True)
class Block:
    """Some rows of a file as they stand, good and bad."""

    records: Records
    coordinates: Points
    """(m, 3) file coordinates in file units, poses applied; NaN where the row has none."""
    is_invalid: Mask | None = None
    """(m,), rows the file itself marks as invalid."""


class Scan(Protocol):
    """One cloud of a file that is read in blocks."""

    path: Path
    name: str
    header: Any
    crs: str | None
    notes: tuple[str, ...]
    bits: dict[str, BitField]

    def blocks(self, rows: int) -> Iterator[Block]:
        """Yield the scan from its beginning in blocks of at most `rows`."""
        ...


@dataclass(slots=True)
class Survey:
    """What one pass over all blocks of a file finds."""

    low: NDArray[np.float64] = field(default_factory=lambda: np.full(3, np.inf))
    high: NDArray[np.float64] = field(default_factory=lambda: np.full(3, -np.inf))
    decimals: list[int | None] = field(default_factory=lambda: [0, 0, 0])
    """Decimal places that hold every coordinate exactly, per axis; None: true floats."""
    rows: int = 0
    not_finite: int = 0
    too_far: int = 0
    """Rows with a number beyond `FARTHEST`."""
    invalid: int = 0
    lacking: str = "no finite coordinates"
    """What a row that is not finite had."""
    of_scans: list[Survey] = field(default_factory=list)
    """How many rows of each scan are good and bad."""

    def add(self, block: Block) -> Mask:
        """Count a block in and return which of its rows are good."""
        is_ok = self.count(block)
        self.widen(block, is_ok)
        return is_ok

    def widen(self, block: Block, is_ok: Mask) -> None:
        """Take in where the good rows (n,) of a block lie."""
        if not is_ok.any():
            return
        good = block.coordinates if is_ok.all() else block.coordinates[is_ok]
        for axis in range(3):
            column = np.ascontiguousarray(good[:, axis])
            self.low[axis] = min(self.low[axis], column.min())
            self.high[axis] = max(self.high[axis], column.max())
            self.decimals[axis] = decimals_of(column, self.decimals[axis])

    def count(self, block: Block) -> Mask:
        """Count the rows of a block, good and bad, and return which are good."""
        is_ok: Mask = usable_rows(block.coordinates)
        self.rows += len(is_ok)
        is_invalid = np.zeros_like(is_ok) if block.is_invalid is None else block.is_invalid
        if is_ok.all() and not is_invalid.any():
            return is_ok
        is_bad = ~is_ok & ~is_invalid
        too_far = int(np.isfinite(block.coordinates[is_bad]).all(axis=1).sum())
        self.invalid += int(is_invalid.sum())
        self.too_far += too_far
        self.not_finite += int(is_bad.sum()) - too_far
        return is_ok & ~is_invalid

    @property
    def kept(self) -> int:
        """Rows with usable coordinates."""
        return self.rows - self.not_finite - self.too_far - self.invalid

    def notes(self) -> tuple[str, ...]:
        """Return what was dropped, counted, in words."""
        found = []
        if self.not_finite:
            found.append(
                f"{self.not_finite} of {self.rows} rows had {self.lacking} and were dropped."
            )
        if self.too_far:
            found.append(
                f"{self.too_far} of {self.rows} rows had a coordinate beyond {FARTHEST:.1g}, as "
                "files write where there are no data, and were dropped."
            )
        if self.invalid:
            found.append(
                f"{self.invalid} of {self.rows} points were marked invalid by the file "
                "and were dropped."
            )
        return tuple(found)


def usable_rows(coordinates: Points) -> Mask:
    """Return which rows (n, 3) hold a place: finite numbers, none beyond `FARTHEST`."""
    low, high = coordinates.min(initial=0.0), coordinates.max(initial=0.0)
    if low >= -FARTHEST and high <= FARTHEST:  # NaN fails either comparison
        return np.ones(len(coordinates), dtype=bool)
    is_usable: Mask = np.asarray((np.abs(coordinates) <= FARTHEST).all(axis=1))
    return is_usable


def _is_on_lattice(values: NDArray[np.float64], decimals: int) -> bool:
    """Say whether `values` are decimals with so many places, as near as float64 can hold them."""
    scaled = values * 10.0**decimals
    # Parsing and the product each round once: four units in the last place are ample.
    return bool((np.abs(scaled - np.rint(scaled)) <= 4 * np.spacing(np.abs(scaled))).all())


def decimals_of(values: NDArray[np.float64], start: int | None) -> int | None:
    """Return the fewest decimal places, at least `start`, that hold all `values`; None: floats."""
    if start is None:
        return None
    for decimals in range(start, MOST_DECIMALS + 1):
        if _is_on_lattice(values[:256], decimals) and _is_on_lattice(values, decimals):
            return decimals
    return None


@dataclass(frozen=True, slots=True)
class Lattice:
    """How file coordinates of one file become local metres, the same for every block."""

    frame: Frame
    low: NDArray[np.float64]
    """(3,) local zero: integer multiples of the step where there is one, else file units."""
    decimals: tuple[int | None, int | None, int | None]

    def local(self, coordinates: Points) -> Points:
        """Turn (m, 3) file coordinates, in their place, into local metres, and return them.

        On a lattice these are exact decimals, so that a shift leaves no trace.
        """
        xyz = coordinates
        for axis, decimals in enumerate(self.decimals):
            if decimals is None:
                np.subtract(coordinates[:, axis], self.low[axis], out=xyz[:, axis])
            else:
                power = 10.0**decimals
                xyz[:, axis] = (np.rint(coordinates[:, axis] * power) - self.low[axis]) / power
            if self.frame.unit_m[axis] != 1.0:
                xyz[:, axis] *= self.frame.unit_m[axis]
        return xyz


def lattice_of(survey: Survey, crs: str | None) -> Lattice:
    """Choose frame and lattice from what a survey of the whole file found."""
    unit_m = units_of(crs).unit_m
    low, origin, steps = np.zeros(3), np.zeros(3), []
    for axis, decimals in enumerate(survey.decimals):
        if decimals is None:
            low[axis] = origin[axis] = np.floor(survey.low[axis])
        else:
            low[axis] = np.rint(survey.low[axis] * 10.0**decimals)
            origin[axis] = low[axis] / 10.0**decimals
            steps.append(10.0**-decimals)
    frame = Frame(
        origin=origin * np.asarray(unit_m),
        crs=crs,
        unit_m=unit_m,
        step=(steps[0], steps[1], steps[2]) if len(steps) == 3 else None,
    )
    first, second, third = survey.decimals
    return Lattice(frame=frame, low=low, decimals=(first, second, third))


def _make(scan: Scan, lattice: Lattice, records: Records, coordinates: Points, notes: Any) -> Cloud:
    return Cloud(
        xyz=lattice.local(coordinates),
        records=records,
        frame=lattice.frame,
        name=scan.name,
        bits=scan.bits,
        header=scan.header,
        viewpoints=_viewpoints(scan.header, lattice.frame),
        notes=(*scan.notes, *unit_notes(lattice.frame), *notes),
    )


def _viewpoints(header: Any, frame: Frame) -> NDArray[np.float64] | None:
    """Return where the scanner stood, (1, 3) local, if the file says where its scan was put."""
    place = getattr(header, "translation", None)
    # Exports without a pose leave zeros, wherever the scanner was.
    if place is None or not np.any(place):
        return None
    return frame.to_local(np.asarray(place, dtype=np.float64)[None])


def survey_of(scans: Iterable[Scan], rows: int) -> Survey:
    """Pass over every block of `scans` once."""
    survey = Survey()
    for scan in scans:
        survey.lacking = _lacking_of(scan)
        mine = Survey(lacking=survey.lacking)
        for block in scan.blocks(rows):
            survey.widen(block, mine.count(block))
        survey.rows += mine.rows
        survey.not_finite += mine.not_finite
        survey.too_far += mine.too_far
        survey.invalid += mine.invalid
        survey.of_scans.append(mine)
    return survey


def _lacking_of(scan: Scan) -> str:
    return str(getattr(scan, "lacking", Survey().lacking))


def _refuse_no_rows(survey: Survey, path: Path) -> None:
    if survey.rows == 0:
        refuse_empty(0, path)
    if survey.kept == 0:
        far = f"{survey.too_far} beyond {FARTHEST:.1g}, " if survey.too_far else ""
        msg = (
            f"{path.name}: none of its {survey.rows} points has usable coordinates "
            f"({survey.not_finite} not finite, {far}{survey.invalid} marked invalid). "
            "Export it again."
        )
        raise FormatError(msg)


def read_scans(scans: list[Scan], rows: int) -> list[Cloud]:
    """Return one cloud per scan, all in one frame; a scan without a good point is left out."""
    whole = Survey()
    gathered = []
    for scan in scans:
        mine, room = Survey(lacking=_lacking_of(scan)), _Room(scan)
        for block in scan.blocks(rows):
            mine.count(block)
            is_ok = whole.add(block)
            room.add(block, is_ok)
        gathered.append((scan, mine, room))
    _refuse_no_rows(whole, scans[0].path)
    lattice = lattice_of(whole, scans[0].crs)
    return [
        _make(scan, lattice, *room.taken(), mine.notes())
        for scan, mine, room in gathered
        if mine.kept
    ]


def scans_without_points(scans: Sequence[Any], survey: Survey) -> list[Cloud]:
    """Return what `read_scans` returns of a surveyed file, but for the points."""
    lattice = lattice_of(survey, scans[0].crs)
    return [
        _make(scan, lattice, np.empty(0, scan.dtype), np.empty((0, 3)), mine.notes())
        for scan, mine in zip(scans, survey.of_scans, strict=True)
        if mine.kept
    ]


def _good(block: Block, is_ok: Mask) -> tuple[Records, Points]:
    """Return the records and coordinates of the good rows."""
    if is_ok.all():
        return block.records, block.coordinates
    return chosen_rows(block.records, is_ok), block.coordinates[is_ok]


class _Room:
    """Where the good rows of a scan are gathered: at their final place if their count is known."""

    def __init__(self, scan: Scan) -> None:
        count = getattr(scan, "count", 0)
        # A damaged header may promise anything; a packed point takes a bit at the very least.
        self._fits = 0 < count <= 8 * scan.path.stat().st_size
        self._count = count
        self._records: list[Records] = []
        self._coordinates: list[Points] = []
        self._filled = 0

    def add(self, block: Block, is_ok: Mask) -> None:
        records, coordinates = _good(block, is_ok)
        if not self._fits:
            self._records.append(records)
            self._coordinates.append(coordinates)
            return
        if not self._records:
            self._records = [np.empty(self._count, dtype=records.dtype)]
            self._coordinates = [np.empty((self._count, 3))]
        place = slice(self._filled, self._filled + len(records))
        self._records[0][place] = records
        self._coordinates[0][place] = coordinates
        self._filled += len(records)

    def taken(self) -> tuple[Records, Points]:
        """Return records and coordinates, and let go of them."""
        if self._fits and self._filled < self._count:
            records, coordinates = self._records[0], self._coordinates[0]
            self._records = [records[: self._filled].copy()]
            self._coordinates = [coordinates[: self._filled].copy()]
        return _joined(self._records), _joined(self._coordinates)


def _joined(parts: list[Any]) -> Any:
    """Concatenate and let go of the parts."""
    joined = parts[0] if len(parts) == 1 else np.concatenate(parts)
    parts.clear()
    return joined


def iterate_scans(scans: list[Scan], rows: int, survey: Survey | None = None) -> Iterator[Cloud]:
    """Yield clouds of at most `rows` points; what was dropped is noted on the first."""
    survey = survey_of(scans, rows) if survey is None else survey
    _refuse_no_rows(survey, scans[0].path)
    lattice = lattice_of(survey, scans[0].crs)
    notes = survey.notes()
    for scan in scans:
        for block in scan.blocks(rows):
            is_ok = Survey().count(block)
            if is_ok.any():
                yield _make(scan, lattice, *_good(block, is_ok), notes)
                notes = ()
