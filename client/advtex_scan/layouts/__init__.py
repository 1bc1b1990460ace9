"""One module per accepted layout, and the registry that finds the one for an archive.

A layout is a module with NAME, `detect(archive) -> Match | None` and `read(reader) -> ScanManifest | None`; to add one,
write the module and put it into LAYOUTS.
"""

from __future__ import annotations

from advtex_scan.archive import ScanArchive
from advtex_scan.layouts import mvs_cam, native, scannet, sens, seven_scenes
from advtex_scan.layouts._reader import Layout, Match, ScanReader

LAYOUTS: tuple[Layout, ...] = (native, scannet, seven_scenes, mvs_cam, sens)

__all__ = ["LAYOUTS", "Layout", "Match", "ScanReader", "detect_layout"]


def detect_layout(archive: ScanArchive) -> tuple[Layout, Match] | None:
    """The surest layout of an archive and what it saw; None if no layout knows it."""
    matches = [(layout, match) for layout in LAYOUTS if (match := layout.detect(archive))]
    return max(matches, key=lambda pair: pair[1].score) if matches else None
