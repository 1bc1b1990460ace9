"""One module per accepted layout, and the registry that finds the one for an archive.

A layout is a module with NAME, `detect(archive) -> Match | None` and `read(reader) -> ScanManifest | None`; to add one,
write the module and put it into LAYOUTS.
"""

from __future__ import annotations

from advtex_scan.archive import ScanArchive
from advtex_scan.layouts import (
    arkitscenes,
    colmap,
    mvs_cam,
    native,
    nerfstudio,
    polycam,
    record3d,
    redwood,
    replica,
    scanner_app,
    scannet,
    sens,
    seven_scenes,
    stray_scanner,
    sun3d,
    tum,
)
from advtex_scan.layouts._reader import Layout, Match, ScanReader

LAYOUTS: tuple[Layout, ...] = (
    native,
    scannet,
    seven_scenes,
    mvs_cam,
    sens,
    tum,
    redwood,
    sun3d,
    replica,
    arkitscenes,
    colmap,
    polycam,
    record3d,
    stray_scanner,
    scanner_app,
    nerfstudio,
)

LAYOUT_NAMES = tuple(layout.NAME for layout in LAYOUTS)

__all__ = ["LAYOUTS", "LAYOUT_NAMES", "Layout", "Match", "ScanReader", "matching_layouts"]


def matching_layouts(archive: ScanArchive) -> list[tuple[Layout, Match]]:
    """Return the layouts that an archive may be of and what each saw, the surest first."""
    matches = [(layout, match) for layout in LAYOUTS if (match := layout.detect(archive))]
    return sorted(matches, key=lambda pair: pair[1].score, reverse=True)
