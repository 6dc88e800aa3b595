"""A cloud: local coordinates beside the input's own records.

Filters select and registration moves; nothing else changes a point. So a cloud carries the
records exactly as its file held them, and float64 coordinates in a local frame to work on.
Selecting selects both. A writer emits the records; only a moved cloud gets new coordinates.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dougong._checks import as_points, as_stored, as_transform, refuse_other_shape
from dougong.errors import InputError
from dougong.typing import Index, Mask, Points, Transform

FARTHEST = 2.0**53 / 1e6
"""No place on a map has a larger number, whatever its unit; up to here, 9.0e9, float64 holds six
decimal places exactly. What lies beyond stands for "no data" (-3.4e38, 1e20)."""

Records = NDArray[np.void]
"""(n,), structured: one record per point, fields named and typed as in the file."""


@dataclass(frozen=True, slots=True)
class BitField:
    """Where a small number sits inside an integer field of the records."""

    field: str
    mask: int
    shift: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """How local metres relate to the coordinates of a file.

    local = (file coordinates x unit) - origin, per axis; file = (local + origin) / unit.
    """

    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    """(3,), metres; the file coordinates (in metres) of the local origin."""
    crs: str | None = None
    """Coordinate reference system of the file, WKT."""
    unit_m: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Metres per file unit along x, y, z."""
    step: tuple[float, float, float] | None = None
    """Smallest coordinate step of the file along x, y, z in file units; None: floats."""

    def to_file(self, points: Points) -> Points:
        """Return local `points` (n, 3) as file coordinates, in file units."""
        coordinates: Points = (points + self.origin) / np.asarray(self.unit_m)
        return coordinates

    def to_local(self, coordinates: Points) -> Points:
        """Return file `coordinates` (n, 3), in file units, as local metres."""
        local: Points = coordinates * np.asarray(self.unit_m) - self.origin
        return local

    def T_file_local(self) -> Transform:
        """Return the (4, 4) affine map from local metres to file coordinates."""
        matrix = np.diag([*(1.0 / np.asarray(self.unit_m)), 1.0])
        matrix[:3, 3] = self.origin / np.asarray(self.unit_m)
        return matrix


_DIRECTIONS = (
    ("nx", "ny", "nz"),
    ("normal_x", "normal_y", "normal_z"),
    ("NormalX", "NormalY", "NormalZ"),
    ("x_t", "y_t", "z_t"),
)
"""Record fields that hold a direction: normals, and the pulse direction of LAS waveforms."""


def _turned(records: Records, linear: NDArray[np.float64]) -> Records:
    """Return `records` with their directions turned by the rotation in `linear` (3, 3)."""
    names = set(records.dtype.names or ())
    found = [
        axes
        for axes in _DIRECTIONS
        if set(axes) <= names and all(records.dtype[axis].kind == "f" for axis in axes)
    ]
    if not found:
        return records
    rotation = linear / np.cbrt(np.linalg.det(linear))
    records = records.copy()
    for axes in found:
        old = np.stack([records[axis] for axis in axes], axis=1).astype(np.float64)
        for axis, values in zip(axes, (old @ rotation.T).T, strict=True):
            records[axis] = values
    return records


def chosen_rows(records: Records, chosen: Mask | Index) -> Records:
    """Return the `chosen` records: a mask (n,) or places (k,).

    The same as indexing, in a tenth of its time: that copies a structured record field by field,
    taking copies its bytes.

    Raises
    ------
    InputError
        A mask of another length.
    """
    rows: NDArray[Any] = np.asarray(chosen)
    if rows.dtype == np.bool_:
        if len(rows) != len(records):
            msg = f"a mask needs one value per point, got {len(rows)} for {len(records)} points."
            raise InputError(msg)
        rows = np.flatnonzero(rows)
    taken: Records = records.take(rows)
    return taken


def transformed(xyz: Points, linear: NDArray[np.float64], shift: NDArray[np.float64]) -> Points:
    """Return linear @ p + shift of each point: every row by itself, whatever rows are beside it.

    By columns: BLAS is slow on products as thin as this, and sums by the number of rows.
    """
    x, y, z = (np.ascontiguousarray(xyz[:, axis]) for axis in range(3))
    moved = np.empty_like(xyz)
    for axis in range(3):
        column = x * linear[axis, 0]
        column += y * linear[axis, 1]
        column += z * linear[axis, 2]
        column += shift[axis]
        moved[:, axis] = column
    return moved


def _refuse_no_places(xyz: Points) -> None:
    is_far = (np.abs(xyz) > FARTHEST).any(axis=1)
    if is_far.any():
        msg = (
            f"points has {is_far.sum()} of {len(xyz)} rows with a coordinate beyond {FARTHEST:.1g} "
            f"(first: row {np.flatnonzero(is_far)[0]}), which is no place. "
            f"Drop them: points[(abs(points) <= {FARTHEST:.1g}).all(1)]."
        )
        raise InputError(msg)


def _step_in(source: Frame, target: Frame, scale: float) -> tuple[float, float, float] | None:
    """Return the source's finest step in target units: a turn mixes the axes."""
    if source.step is None:
        return None
    finest = min(s * u for s, u in zip(source.step, source.unit_m, strict=True))
    if scale < 0.99:  # neither a rotation nor a map's scale must cost the step a digit
        finest *= scale
    x, y, z = (finest / unit for unit in target.unit_m)
    return (x, y, z)


@dataclass(frozen=True, slots=True, kw_only=True)
class Cloud:
    """Points of one scan or flight. Immutable: every method returns a new cloud."""

    xyz: Points
    """(n, 3) metres in the local frame."""
    records: Records
    """(n,) the input's own records."""
    frame: Frame
    name: str = "cloud"
    bits: Mapping[str, BitField] = field(default_factory=dict)
    """Attributes packed into bits of a record field (LAS flags)."""
    header: Any = None
    """What the format that read the cloud needs to write it again; opaque here."""
    motion: Transform | None = None
    """(4, 4) what `moved` did so far, between file coordinates; None: as the file has it."""
    viewpoints: NDArray[np.float64] | None = None
    """(k, 3) metres, local frame: where the scanner stood. The attribute `station` is the row of
    each point; without it row 0 is every point's. NaN rows, or None: unknown."""
    notes: tuple[str, ...] = ()
    """What was handled while reading, in words and counted ("12 rows with NaN dropped")."""

    def __post_init__(self) -> None:
        if self.xyz.shape != (len(self.records), 3):
            msg = f"a cloud needs one record per point, got {self.xyz.shape}, {len(self.records)}."
            raise InputError(msg)

    def __len__(self) -> int:
        return len(self.xyz)

    @classmethod
    def from_points(
        cls,
        points: ArrayLike,
        *,
        name: str = "cloud",
        crs: str | None = None,
        **attributes: ArrayLike,
    ) -> Cloud:
        """Build a cloud from an array.

        Parameters
        ----------
        points : array_like, shape (n, 3)
            Metres, as large as map coordinates are; the local origin is their rounded low corner.
        **attributes : array_like, shape (n,)
            Further fields of the records (``intensity=``, ``red=`` ...), kept with their dtype.

        Raises
        ------
        InputError
            A coordinate is not finite or beyond `FARTHEST`, an attribute has another length or
            the name of a coordinate.
        """
        xyz = as_points(points)
        columns = {name_: np.asarray(values) for name_, values in attributes.items()}
        for name_, values in columns.items():
            if name_ in ("x", "y", "z"):
                msg = (
                    f"{name_} is a coordinate and comes from points. Name the attribute otherwise."
                )
                raise InputError(msg)
            refuse_other_shape(name_, values, (len(xyz),))
        _refuse_no_places(xyz)
        origin = np.floor(xyz.min(axis=0)) if len(xyz) else np.zeros(3)
        dtype = [(axis, "<f8") for axis in "xyz"]
        dtype += [(name_, values.dtype.str) for name_, values in columns.items()]
        records = np.empty(len(xyz), dtype=dtype)
        for index, axis in enumerate("xyz"):
            records[axis] = xyz[:, index]
        for name_, values in columns.items():
            records[name_] = values
        return cls(
            xyz=xyz - origin, records=records, frame=Frame(origin=origin, crs=crs), name=name
        )

    @property
    def is_moved(self) -> bool:
        """True once `xyz` no longer follows from the records: a writer must see to it."""
        return self.motion is not None

    @property
    def attributes(self) -> tuple[str, ...]:
        """Names that `attribute` knows, coordinates included."""
        packed = {bit.field for bit in self.bits.values()}
        plain = [name for name in self.records.dtype.names or () if name not in packed]
        return (*plain, *self.bits)

    def attribute(self, name: str) -> NDArray[Any] | None:
        """Return the (n,) attribute `name` as stored, or None if the records have none."""
        if name in self.bits:
            bit = self.bits[name]
            values: NDArray[Any] = (self.records[bit.field] & bit.mask) >> bit.shift
            return values
        if name in (self.records.dtype.names or ()):
            stored: NDArray[Any] = self.records[name]
            return stored
        return None

    def select(self, chosen: Mask | Index) -> Cloud:
        """Return the cloud of the `chosen` points: a mask (n,) or indices (k,)."""
        return replace(
            self,
            xyz=np.ascontiguousarray(self.xyz[chosen]),
            records=chosen_rows(self.records, chosen),
        )

    def with_attribute(self, name: str, values: ArrayLike) -> Cloud:
        """Return the cloud with attribute `name` (n,) set, added to the records when new.

        Raises
        ------
        InputError
            Another shape, or a value that an attribute which is there already cannot hold in its
            type.
        """
        column = np.asarray(values)
        is_field = name in (self.records.dtype.names or ()) and name not in self.bits
        width = self.records.dtype[name].shape if is_field else ()
        refuse_other_shape(name, column, (len(self), *width))
        if name in self.bits:
            bit = self.bits[name]
            if len(column) and (column.min() < 0 or column.max() > bit.mask >> bit.shift):
                msg = (
                    f"{name} must lie in 0..{bit.mask >> bit.shift} in this point format, "
                    f"got {column.min()}..{column.max()}. Write to LAS 1.4 (point format 6 or up)."
                )
                raise InputError(msg)
            records = self.records.copy()
            stored = records[bit.field]
            fitted = as_stored(name, column, stored.dtype)
            stored[:] = (stored & ~stored.dtype.type(bit.mask)) | (fitted << bit.shift)
            return replace(self, records=records)
        if is_field:
            records = self.records.copy()
            records[name] = as_stored(name, column, self.records.dtype[name].base)
            return replace(self, records=records)
        dtype = [(old, self.records.dtype[old]) for old in self.records.dtype.names or ()]
        records = np.empty(len(self), dtype=[*dtype, (name, column.dtype)])
        for old, _ in dtype:
            records[old] = self.records[old]
        records[name] = column
        return replace(self, records=records)

    def moved(self, T_target_source: Transform, target: Frame | None = None) -> Cloud:
        """Return the cloud moved by a matrix between *file* coordinates.

        Parameters
        ----------
        T_target_source : ndarray, shape (4, 4)
            Maps this cloud's file coordinates to the target's file coordinates.
        target : Frame, optional
            The frame of the target; by default metres, without a CRS, round the moved points.

        Notes
        -----
        Normals in the records (nx ny nz and their like) turn with the points; nothing else of the
        records changes. The step of the new frame is the input's finest, in the target's units.
        """
        matrix = as_transform(T_target_source)
        if target is None:
            target = Frame(
                origin=np.round(matrix[:3, :3] @ self.frame.T_file_local()[:3, 3] + matrix[:3, 3])
            )
        # Both shifts are folded into one small translation before any point is touched.
        linear = (
            np.diag(target.unit_m) @ matrix[:3, :3] @ np.diag(1.0 / np.asarray(self.frame.unit_m))
        )
        shift = (
            linear @ self.frame.origin + np.asarray(target.unit_m) * matrix[:3, 3] - target.origin
        )
        xyz = transformed(self.xyz, linear, shift)
        seen_from = None if self.viewpoints is None else self.viewpoints @ linear.T + shift
        step = _step_in(self.frame, target, float(np.cbrt(np.linalg.det(linear))))
        return replace(
            self,
            xyz=xyz,
            records=_turned(self.records, matrix[:3, :3]),
            frame=replace(target, step=step),
            motion=matrix if self.motion is None else matrix @ self.motion,
            viewpoints=seen_from,
        )

    def stretched(self, factors: float | NDArray[np.float64], frame: Frame) -> Cloud:
        """Return the cloud with its local coordinates multiplied, in a `frame` that says so.

        No motion: what the file's numbers mean is another, or an axis runs the other way.

        Parameters
        ----------
        factors : float or ndarray, shape (3,)
        frame : Frame
            Of the result.
        """
        seen_from = None if self.viewpoints is None else self.viewpoints * factors
        return replace(self, xyz=self.xyz * factors, frame=frame, viewpoints=seen_from)

    def rebased(self, origin: NDArray[np.float64]) -> Cloud:
        """Return the same points in local coordinates about another `origin` (3,), metres."""
        shift = self.frame.origin - origin
        return replace(
            self,
            xyz=self.xyz + shift,
            frame=replace(self.frame, origin=origin),
            viewpoints=None if self.viewpoints is None else self.viewpoints + shift,
        )


Pieces = Callable[[], Iterable[Cloud]]
"""Yields a cloud piece by piece, from its beginning at every call; at least one piece. All have
one frame, header and layout."""


def in_pieces(cloud: Cloud | Pieces) -> Pieces:
    """Return a cloud as one piece; pieces as they are."""
    return (lambda: (cloud,)) if isinstance(cloud, Cloud) else cloud


def joined_pieces(pieces: Pieces) -> Cloud:
    """Return a cloud that comes in pieces as a whole."""
    return joined(list(pieces()))


def joined(parts: Sequence[Cloud]) -> Cloud:
    """Return clouds of one frame and layout, at least one, as one."""
    if len(parts) == 1:
        return parts[0]
    return replace(
        parts[0],
        xyz=np.concatenate([part.xyz for part in parts]),
        records=np.concatenate([part.records for part in parts]),
    )
