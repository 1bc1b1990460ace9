"""What a scan is: manifest, archive access, layouts and the structural check. Standard library only.

with open_scan("scan.zip") as archive:
    reading = read_scan(archive)
    if reading.report.ok:
        jpeg = archive.read(reading.manifest.frames[0].color)

print(check_scan("scan.zip").format_text())
"""

from advtex_scan._names import unsafe_reason
from advtex_scan._zip_directory import ArchiveLimits
from advtex_scan.archive import ScanArchive, open_scan
from advtex_scan.check import CheckReport, ScanReading, check_scan, read_scan
from advtex_scan.errors import (
    ArchiveError,
    Finding,
    ImageError,
    LimitError,
    MeshError,
    ScanFormatError,
    UnsafeArchiveError,
)
from advtex_scan.images import ImageHeader, read_image_header
from advtex_scan.manifest import (
    IDENTITY,
    ByteRange,
    Distortion,
    FileRef,
    FrameEntry,
    Intrinsics,
    Matrix4,
    MeshEntry,
    MeshRefinement,
    ScanKind,
    ScanManifest,
    UpAxis,
    VideoFrame,
)
from advtex_scan.mesh import MeshFacts
from advtex_scan.remote import open_remote

__all__ = [
    "IDENTITY",
    "ArchiveError",
    "ArchiveLimits",
    "ByteRange",
    "CheckReport",
    "Distortion",
    "FileRef",
    "Finding",
    "FrameEntry",
    "ImageError",
    "ImageHeader",
    "Intrinsics",
    "LimitError",
    "Matrix4",
    "MeshEntry",
    "MeshError",
    "MeshFacts",
    "MeshRefinement",
    "ScanArchive",
    "ScanFormatError",
    "ScanKind",
    "ScanManifest",
    "ScanReading",
    "UnsafeArchiveError",
    "UpAxis",
    "VideoFrame",
    "check_scan",
    "open_remote",
    "open_scan",
    "read_image_header",
    "read_scan",
    "unsafe_reason",
]
