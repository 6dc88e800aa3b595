"""The bytes of E57: checksums, bits, pages."""

import io
from pathlib import Path

import numpy as np
import pytest

from dougong.errors import FormatError
from dougong.formats.e57_container import Appender, Pages, read_layout
from dougong.kernels.bits import pack_bits
from dougong.kernels.crc32c import page_checksums
from reference.formats import crc32c
from reference.formats import pack_bits as slow_pack_bits


@pytest.mark.parametrize("size", [0, 1, 7, 8, 9, 1020])
def test_checksums_against_the_slow_twin(size):
    pages = np.random.default_rng(size).integers(0, 256, (4, size), dtype=np.uint8)
    found = np.empty(4, dtype=np.uint32)
    page_checksums(pages, found)
    assert found.tolist() == [crc32c(bytes(page)) for page in pages]


def test_the_checksum_of_the_standard_s_test_word():
    found = np.empty(1, dtype=np.uint32)
    page_checksums(np.frombuffer(b"123456789", dtype=np.uint8)[None], found)
    assert found[0] == 0xE3069283


@pytest.mark.parametrize("bits", range(1, 65))
def test_bits_against_the_slow_twin(bits):
    values = np.random.default_rng(bits).integers(0, 2**64 - 1, 37, dtype=np.uint64)
    values[:2] = 0, 2**64 - 1
    out = np.zeros(-(-37 * bits // 8), dtype=np.uint8)
    pack_bits(values, bits, out)
    assert out.tobytes() == slow_pack_bits(values, bits)


@pytest.fixture
def pages():
    """A file of four pages, written piece by piece."""
    file = io.BytesIO()
    out = Appender(file)
    data = np.random.default_rng(0).integers(0, 256, 4000, dtype=np.uint8)
    for start in range(0, 4000, 333):
        out.write(data[start : start + 333])
    out.finish(b"<e57Root/>")
    layout = read_layout(io.BytesIO(file.getvalue()), Path("a.e57"))
    return Pages(file, layout, "a.e57"), bytes(48) + data.tobytes()


def test_logical_bytes_are_what_was_written(pages):
    file, data = pages
    assert file.read(48, 4000) == data[48:]
    assert file.read(1019, 3) == data[1019:1022]
    assert file.read(file.layout.xml_start, file.layout.xml_bytes) == b"<e57Root/>"
    assert file.layout.file_bytes == 4 * 1024


def test_writing_in_the_middle_leaves_the_rest(pages):
    file, data = pages
    file.write(1018, b"12345")
    assert file.read(48, 4000) == data[48:1018] + b"12345" + data[1023:]


def test_positions_there_and_back(pages):
    layout = pages[0].layout
    for logical in (0, 48, 1019, 1020, 1021, 4080):
        assert layout.logical(layout.physical(logical)) == logical
    assert layout.physical(1020) == 1024


def test_what_is_not_e57_is_said(tmp_path):
    for data, said in (
        (b"LASF" + bytes(60), "is not an E57 file"),
        (b"ASTM-E57" + bytes(8), "ends inside its header"),
        (b"ASTM-E57" + bytes(40), "damaged E57 header"),
    ):
        with pytest.raises(FormatError, match=said):
            read_layout(io.BytesIO(data), Path("a.e57"))
