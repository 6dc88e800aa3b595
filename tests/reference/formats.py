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
