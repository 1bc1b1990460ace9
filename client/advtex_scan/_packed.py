"""Files of plain numbers, and what their heads and ends say without unpacking them: LZFSE streams and NumPy arrays."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

from advtex_scan.archive import ScanArchive
from advtex_scan.errors import ArchiveError, Finding
from advtex_scan.manifest import ByteRange

LZFSE_END = b"bvx$"
LZFSE_BLOCKS = 10_000  # of at least one byte each; an encoder packs up to 40 kB into one
LZFSE_V1_HEAD = 772  # bytes
NPY_MAGIC = b"\x93NUMPY"
NPY_HEAD = 4 << 10
NPY_TYPES = {"<u2": "u16", "<f4": "f32", "<f8": "f64", "|u1": "u8", "<i8": "i64"}
REMEDY = "copy the file again in full, or export the scan again"


@dataclass(frozen=True, slots=True)
class NpyHeader:
    """A two-dimensional array in a `.npy` file: the type of its numbers, size, and where its rows begin."""

    type: str
    width: int
    height: int
    start: int


def check_lzfse(archive: ScanArchive, ref: ByteRange, size: int) -> None:
    """Raise ArchiveError unless the bytes are an LZFSE stream that holds `size` bytes."""
    held = lzfse_size(archive, ref)
    if held != size:
        raise _broken(ref.path, f"holds {held} bytes; an image of its size has {size}")


def lzfse_size(archive: ScanArchive, ref: ByteRange) -> int:
    """Return how many bytes an LZFSE stream says it holds. Raises ArchiveError if it is none or cut off.

    The heads of its blocks are read only; see `lzfse_internal.h` of the reference implementation.
    """
    data = archive.read(ref)
    position, held = 0, 0
    for _ in range(LZFSE_BLOCKS):
        kind = data[position : position + 4]
        if kind == LZFSE_END and position + 4 == len(data):
            return held
        head = data[position + 4 : position + 32]
        if len(head) < 8:
            break
        raw, payload = struct.unpack_from("<2I", head)
        if kind == b"bvx-":
            length = 8 + raw
        elif kind == b"bvxn":
            length = 12 + payload
        elif kind == b"bvx1":
            length = LZFSE_V1_HEAD + payload
        elif kind == b"bvx2" and len(head) == 28:
            literals, others, states = struct.unpack_from("<3Q", head, 4)
            length = (states & 0xFFFFFFFF) + (literals >> 20 & 0xFFFFF) + (others >> 40 & 0xFFFFF)
        else:
            break
        held += raw
        position += max(8, length)
    raise _broken(ref.path, "is no whole LZFSE stream")


def read_npy_header(archive: ScanArchive, name: str) -> NpyHeader:
    """Read the header of an array. Raises ArchiveError if it is none of two dimensions, of another type, or cut off."""
    data = archive.head(name, NPY_HEAD)
    if len(data) < 12 or not data.startswith(NPY_MAGIC) or data[6] not in (1, 2, 3):
        raise _broken(name, "is no NumPy array")
    start = 10 + struct.unpack_from("<H", data, 8)[0] if data[6] == 1 else 12 + struct.unpack_from("<I", data, 8)[0]
    text = data[10:start].decode("latin-1")
    kind = re.search(r"'descr': '([^']{1,8})'", text)
    shape = re.search(r"'shape': \((\d{1,6}), (\d{1,6})\)", text)
    if not kind or not shape or "'fortran_order': False" not in text or kind[1] not in NPY_TYPES:
        raise _broken(name, "is no NumPy array of rows and columns of plain numbers")
    header = NpyHeader(NPY_TYPES[kind[1]], int(shape[2]), int(shape[1]), start)
    length = start + header.width * header.height * int(kind[1][2])
    if length != archive.size(name) or not header.width or not header.height:
        raise _broken(name, f"is {archive.size(name)} bytes long, not the {length} that its header says")
    return header


def _broken(name: str, what: str) -> ArchiveError:
    return ArchiveError(Finding("error", "bad_numbers", name, what, REMEDY))
