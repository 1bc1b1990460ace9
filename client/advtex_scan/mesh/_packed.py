"""Numbers that stand in rows of bytes, gathered by slices of bytes, which the interpreter copies at memory speed."""

from __future__ import annotations

import struct
import sys
from array import array
from typing import Any

LITTLE = sys.byteorder == "little"


def gather(rows: bytes, stride: int, offset: int, kind: str, count: int, order: str) -> array[Any]:
    """`count` numbers that stand side by side at `offset` of each row of `stride` bytes, in turn.

    kind: their struct code; order: "<" or ">", their bytes' order. Floats keep their width, integers become "q".
    """
    width = struct.calcsize(f"<{kind}")
    if len(rows) == stride and count > 1:  # one row: its numbers are the rows
        rows, stride, offset, count = rows[offset : offset + count * width], width, 0, 1
    wide = width if kind in "fd" else 8
    total = len(rows) // stride
    values = array(kind if kind in "fd" else "q")
    out = bytearray(total * count * wide)
    for number in range(count):
        first = offset + number * width
        for byte in range(width):  # counted from the lowest
            source = first + (byte if order == "<" else width - 1 - byte)
            target = number * wide + (byte if LITTLE else wide - 1 - byte)
            out[target :: count * wide] = rows[source::stride]
        if kind in "bhi" and not rows[first + (width - 1 if order == "<" else 0) :: stride].isascii():
            return _signed(rows, stride, offset, kind, count, order)
    values.frombytes(out)
    return values


def _signed(rows: bytes, stride: int, offset: int, kind: str, count: int, order: str) -> array[int]:
    """`gather` of integers of which some are negative."""
    layout = struct.Struct(f"{order}{offset}x{count}{kind}{stride - offset - count * struct.calcsize('<' + kind)}x")
    return array("q", [value for row in layout.iter_unpack(rows) for value in row])
