"""Slow twins of the kernels behind the formats."""


def cube_code(point, low, scale):
    """Return the 63-bit Morton code of one integer point, bit by bit."""
    steps = [value - corner for value, corner in zip(point, low, strict=True)]
    cells = [min(int(v * s), 2**21 - 1) for v, s in zip(steps, scale, strict=True)]
    code = 0
    for bit in range(21):
        for axis in range(3):
            code |= ((cells[axis] >> bit) & 1) << (3 * bit + axis)
    return code


def unpack_lzf(data):
    """Return LZF `data` unpacked, byte by byte."""
    out = bytearray()
    i = 0
    while i < len(data):
        control = data[i]
        i += 1
        if control < 32:
            out += data[i : i + control + 1]
            i += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[i]
            i += 1
        start = len(out) - ((control & 31) << 8) - data[i] - 1
        i += 1
        for k in range(length + 2):
            out.append(out[start + k])
    return bytes(out)


def crc32c(data):
    """Return the CRC-32C of bytes, bit by bit."""
    value = 0xFFFFFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ (0x82F63B78 if value & 1 else 0)
    return value ^ 0xFFFFFFFF


def pack_bits(values, bits):
    """Return integers packed lowest bit first, as one very large integer."""
    whole = sum((int(value) & ((1 << bits) - 1)) << (k * bits) for k, value in enumerate(values))
    return whole.to_bytes(-(-len(values) * bits // 8), "little")
