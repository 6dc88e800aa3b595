"""Fields of E57 records: their names, what they may hold, how they are stored."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dougong.errors import OutputError

LENGTHS = ("cartesianX", "cartesianY", "cartesianZ", "sphericalRange")
"""Fields of a record that are lengths, so that a scale applies to them."""
INVALID = ("cartesianInvalidState", "sphericalInvalidState")
"""Fields that say which points have no position."""
NORMAL = ("nx", "ny", "nz")
NORMALS_URI = "http://www.libe57.org/E57_NOR_surface_normals.txt"
OURS, OURS_URI = "dougong", "urn:dougong:e57-attributes:1"
"""Extension (prefix and id) for attributes that E57 has no name for."""


_NAMES = {
    "colorRed": "red", "colorGreen": "green", "colorBlue": "blue", "rowIndex": "row_index",
    "columnIndex": "column_index", "returnIndex": "return_index", "returnCount": "return_count",
    "timeStamp": "time_stamp", "nor:normalX": "nx", "nor:normalY": "ny", "nor:normalZ": "nz",
}  # fmt: skip
_FIELDS = {attribute: name for name, attribute in _NAMES.items()}


def attribute_name(field: str) -> str:
    """Return what an E57 field is called as an attribute of a cloud."""
    return _NAMES.get(field, field.removeprefix(f"{OURS}:"))


def field_name(attribute: str) -> str:
    """Return the E57 field of an attribute: the standard's name, else one of our extension."""
    if attribute == "intensity":
        return attribute
    safe = re.sub(r"[^A-Za-z0-9_.-]", "_", attribute)
    safe = safe if re.match(r"[A-Za-z_]", safe) else f"_{safe}"
    return _FIELDS.get(attribute, f"{OURS}:{safe}")


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldSpec:
    """One field of a scan's records: its type and limits, as the file states them."""

    kind: Literal["integer", "scaled", "float"]
    low: float
    """Least stored number: an int of integers; of floats the least value."""
    high: float
    scale: float = 1.0
    offset: float = 0.0
    is_single: bool = False

    def scaled(self, factor: float) -> FieldSpec:
        """Return the field of lengths that are multiplied by `factor`."""
        if factor == 1.0:
            return self
        if self.kind == "float":
            return replace(self, low=self.low * factor, high=self.high * factor)
        return replace(self, kind="scaled", scale=self.scale * factor, offset=self.offset * factor)

    @property
    def has_limits(self) -> bool:
        """False for a float that may be anything its precision holds."""
        most = float(np.finfo("f4" if self.is_single else "f8").max)
        return self.kind != "float" or self.low > -most or self.high < most

    @property
    def bits(self) -> int:
        """Bits of one number in a record; none for an integer that is always the same."""
        if self.kind == "float":
            return 32 if self.is_single else 64
        return (int(self.high) - int(self.low)).bit_length()

    def raw(self, values: NDArray[Any], name: str) -> NDArray[Any]:
        """Return values (n,) of field `name` as a file stores them: int64 or floats.

        Raises
        ------
        OutputError
            A number lies outside the field's limits.
        """
        if self.kind == "float":
            stored: NDArray[Any] = values.astype("<f4" if self.is_single else "<f8")
            return stored
        integers: NDArray[np.int64] = (
            values.astype(np.int64)
            if self.kind == "integer"
            else np.rint((values.astype(np.float64) - self.offset) / self.scale).astype(np.int64)
        )
        if len(integers) and not (self.low <= integers.min() and integers.max() <= self.high):
            msg = (
                f"{name} holds {integers.min()} to {integers.max()} (stored integers), and its E57 "
                f"field takes {self.low} to {self.high}. Write another format."
            )
            raise OutputError(msg)
        return integers

    def packed(self, stored: NDArray[Any]) -> NDArray[np.uint8]:
        """Return what `raw` gave as the bytes of a stream."""
        if self.kind == "float":
            return np.ascontiguousarray(stored).view(np.uint8)
        bits = self.bits
        above: NDArray[np.uint64] = (stored - np.int64(self.low)).view(np.uint64)
        if bits in (8, 16, 32, 64):
            return above.astype(f"<u{bits // 8}").view(np.uint8)
        out = np.zeros(-(-len(stored) * bits // 8), dtype=np.uint8)
        if bits:
            from dougong.kernels.bits import pack_bits

            pack_bits(above, bits, out)
        return out


def spec_of(node: Any) -> FieldSpec | None:
    """Return what a field of a prototype may hold; None for text."""
    from pye57 import libe57

    if isinstance(node, libe57.FloatNode):
        return FieldSpec(
            kind="float",
            low=float(node.minimum()),
            high=float(node.maximum()),
            is_single=node.precision() == libe57.E57_SINGLE,
        )
    if isinstance(node, libe57.ScaledIntegerNode):
        return FieldSpec(
            kind="scaled",
            low=int(node.minimum()),
            high=int(node.maximum()),
            scale=float(node.scale()),
            offset=float(node.offset()),
        )
    if isinstance(node, libe57.IntegerNode):
        return FieldSpec(kind="integer", low=int(node.minimum()), high=int(node.maximum()))
    return None


def float_field(*, is_single: bool) -> FieldSpec:
    """Return a float field without limits."""
    most = float(np.finfo("f4" if is_single else "f8").max)
    return FieldSpec(kind="float", low=-most, high=most, is_single=is_single)


def integer_field(values: NDArray[Any]) -> FieldSpec:
    """Return an integer field that just holds `values` (n,): a constant takes no room."""
    return FieldSpec(kind="integer", low=int(values.min()), high=int(values.max()))
