"""TIFF files, written entry by entry."""

import struct

SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 10: 8}
"""Bytes of a value by its type."""


def shorts(*values):
    return struct.pack(f"<{len(values)}H", *values)


def longs(*values):
    return struct.pack(f"<{len(values)}I", *values)


def tiff(entries, strips):
    """A file of one picture, uncompressed.

    Args:
        entries: tags, types and values, without those of the strips.
        strips: bytes of each.
    """
    entries = sorted([*entries, (273, 4, longs(*[0] * len(strips))), (279, 4, longs(*map(len, strips)))])
    long_at = 8 + 2 + 12 * len(entries) + 4
    strips_at = long_at + sum(len(value) + len(value) % 2 for _, _, value in entries if len(value) > 4)
    table, long = b"", b""
    for tag, kind, value in entries:
        if tag == 273:
            value = longs(*(strips_at + sum(map(len, strips[:i])) for i in range(len(strips))))
        content = value.ljust(4, b"\0")
        if len(value) > 4:
            content = longs(long_at + len(long))
            long += value + b"\0" * (len(value) % 2)
        table += struct.pack("<HHI", tag, kind, len(value) // SIZES[kind]) + content
    return b"II*\0" + longs(8) + shorts(len(entries)) + table + longs(0) + long + b"".join(strips)
