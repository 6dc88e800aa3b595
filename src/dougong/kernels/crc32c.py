"""CRC-32C (Castagnoli), the checksum of every page of an E57 file (ASTM E2807-11, 7.1)."""

import numpy as np
from numpy.typing import NDArray

from dougong.kernels._jit import kernel

_REVERSED = 0x82F63B78
"""The polynomial 0x1EDC6F41, lowest bit first."""


def _tables() -> NDArray[np.uint32]:
    """Return (8, 256): what a byte does to the remainder, seen 0..7 bytes ahead."""
    tables = np.zeros((8, 256), dtype=np.uint32)
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = (value >> 1) ^ (_REVERSED if value & 1 else 0)
        tables[0, byte] = value
    for ahead in range(1, 8):
        before = tables[ahead - 1]
        tables[ahead] = (before >> 8) ^ tables[0][before & 0xFF]
    return tables


_TABLES = _tables()


@kernel
def page_checksums(pages: NDArray[np.uint8], out: NDArray[np.uint32]) -> None:
    """Fill out[i] with the CRC-32C of pages[i] (n, size): one row, one checksum.

    Eight bytes a step: each is looked up by how far it stands from the step's end.
    """
    size = pages.shape[1]
    whole = size - size % 8
    low = np.uint32(0xFF)
    for i in range(len(pages)):
        row = pages[i]
        crc = np.uint32(0xFFFFFFFF)
        for k in range(0, whole, 8):
            crc = (
                _TABLES[7, (crc ^ row[k]) & low]
                ^ _TABLES[6, ((crc >> np.uint32(8)) ^ row[k + 1]) & low]
                ^ _TABLES[5, ((crc >> np.uint32(16)) ^ row[k + 2]) & low]
                ^ _TABLES[4, ((crc >> np.uint32(24)) ^ row[k + 3]) & low]
                ^ _TABLES[3, row[k + 4]]
                ^ _TABLES[2, row[k + 5]]
                ^ _TABLES[1, row[k + 6]]
                ^ _TABLES[0, row[k + 7]]
            )
        for k in range(whole, size):
            crc = (crc >> np.uint32(8)) ^ _TABLES[0, (crc ^ row[k]) & low]
        out[i] = ~crc
