"""3TZ, the archive format of 3D Tiles: a zip of stored files whose last one tells where each of the others begins.

Source: 3D Tiles Archive Format 1.3. Any program that opens zips takes it apart.
"""

from __future__ import annotations

import hashlib
import struct
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from advtex_engine.runtime.files import atomic_file

INDEX = "@3dtilesIndex1@"


@contextmanager
def tileset_archive(path: Path) -> Iterator[Callable[[str, bytes], None]]:
    """Write an archive that is whole or absent; what is yielded adds a file: its name, with slashes, and its bytes."""
    with atomic_file(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        yield lambda name, data: archive.writestr(_entry(name), data)
        archive.writestr(_entry(INDEX), _index(archive))


def _entry(name: str) -> zipfile.ZipInfo:
    """Of no date, so that the same tiles are the same bytes, and readable by all where it is unpacked."""
    entry = zipfile.ZipInfo(name)
    entry.external_attr = 0o644 << 16
    return entry


def _index(archive: zipfile.ZipFile) -> bytes:
    """24 bytes for each file, MD5 of its name and offset of its header, sorted by the MD5's halves as numbers."""
    entries = [
        (hashlib.md5(entry.filename.encode(), usedforsecurity=False).digest(), entry.header_offset)
        for entry in archive.infolist()
    ]
    entries.sort(key=lambda entry: struct.unpack("<QQ", entry[0]))
    return b"".join(struct.pack("<16sQ", *entry) for entry in entries)
