"""Read a scan and report on it: every problem, where it is, and what helps.

`read_scan` gives the manifest beside the report; `check_scan` only the report, also for what cannot be opened.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from advtex_scan._frames import check_frame
from advtex_scan._sight import check_sight
from advtex_scan.archive import ScanArchive, open_scan
from advtex_scan.errors import Finding, ScanFormatError
from advtex_scan.images import EXR_REMEDY
from advtex_scan.layouts import LAYOUT_NAMES, Layout, Match, ScanReader, matching_layouts
from advtex_scan.layouts._mesh_choice import MESH_SUFFIXES
from advtex_scan.layouts._reader import IMAGE_SUFFIXES
from advtex_scan.manifest import ScanManifest
from advtex_scan.mesh import PLAIN, Arithmetic, MeshFacts, MeshSurface, read_mesh

MIN_FRAMES = 3
KINDS = {
    "images": IMAGE_SUFFIXES,
    "videos": (".mp4", ".mov"),
    "meshes or point clouds": MESH_SUFFIXES,
}


@dataclass(frozen=True, slots=True)
class CheckReport:
    """What was found in a scan.

    layout, why: the layout's name and what gave it away; empty if none was recognized
    sureness: of the layout, 0 to 1
    frames_found, frames_usable: in the files, and left after dropped and broken ones
    dropped: frames left out, by reason
    view_size: width and height of the largest color image, pixels
    """

    layout: str = ""
    why: str = ""
    sureness: float = 0.0
    frames_found: int = 0
    frames_usable: int = 0
    dropped: Mapping[str, int] = field(default_factory=dict)
    mesh: MeshFacts | None = None
    view_size: tuple[int, int] = (0, 0)
    findings: tuple[Finding, ...] = ()

    @property
    def ok(self) -> bool:
        """The scan can be textured: nothing of severity `error` was found."""
        return not any(finding.severity == "error" for finding in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """Return the report as JSON-ready values, `ok` included."""
        return {
            "ok": self.ok,
            "layout": self.layout,
            "why": self.why,
            "sureness": self.sureness,
            "frames_found": self.frames_found,
            "frames_usable": self.frames_usable,
            "dropped": dict(self.dropped),
            "mesh": asdict(self.mesh) if self.mesh else None,
            "view_size": list(self.view_size),
            "findings": [asdict(finding) for finding in self.findings],
        }

    def format_text(self) -> str:
        """Return the report for people, without a final line break."""
        found = f"{self.layout}, {self.sureness:.0%} sure: {self.why}" if self.layout else "not recognized"
        lines = [f"layout   {found}"]
        lines.append(f"frames   {self.frames_usable} usable of {self.frames_found}{_left_out(self.dropped)}")
        lines.append(f"mesh     {self.mesh.describe() if self.mesh else 'none'}")
        for finding in self.findings:
            place = f"{finding.where}: " if finding.where else ""
            lines.append(f"{finding.severity:<8} {place}{finding.message}")
            if finding.remedy:
                lines.append(f"         -> {finding.remedy}")
        lines.append("this scan can be textured" if self.ok else "this scan cannot be textured as it is")
        return "\n".join(lines)


@dataclass(frozen=True, slots=True)
class ScanReading:
    """A scan's manifest with its report. The manifest may be textured only if `report.ok`.

    The manifest holds usable frames only, with color intrinsics at the stored images' size; it is None if no layout
    could make anything of the files. The mesh is the one that the manifest names, None if it names none or it is
    broken.
    """

    manifest: ScanManifest | None
    report: CheckReport
    mesh: MeshSurface | None = None


def check_scan(scan: str | os.PathLike[str] | ScanArchive, layout: str | None = None) -> CheckReport:
    """Report on a folder, a zip or an open archive. Never raises for what is wrong with the scan.

    layout: one of LAYOUT_NAMES to read the files as; None takes the surest.
    """
    if isinstance(scan, ScanArchive):
        return read_scan(scan, layout).report
    try:
        with open_scan(scan) as archive:
            return read_scan(archive, layout).report
    except ScanFormatError as error:
        return CheckReport(findings=error.findings)
    except OSError as error:
        message = f"cannot be read ({error.strerror})"
        return CheckReport(findings=(Finding("error", "unreadable_file", Path(scan).name, message, "check it"),))


def read_scan(archive: ScanArchive, layout: str | None = None, arithmetic: Arithmetic = PLAIN) -> ScanReading:
    """Read an archive's manifest and mesh, and check all that can be checked without decoding images.

    layout: as for `check_scan`; arithmetic: as for `read_mesh`. Nothing that is wrong with the scan raises; it is in
    the report.
    """
    matches = matching_layouts(archive)
    chosen = next((pair for pair in matches if layout in (None, pair[0].NAME)), None)
    if chosen is None:
        return ScanReading(None, CheckReport(findings=(_no_layout(archive, layout, matches),)))
    reader = ScanReader(archive)
    manifest = chosen[0].read(reader)
    mesh = None
    if manifest is not None:
        manifest = _usable(reader, manifest)
        mesh = _check_mesh(reader, manifest, arithmetic)
        _report_ignored(reader)
    for other, match in matches:
        if other is not chosen[0]:
            message = f"the files could also be read as {other.NAME} ({match.score:.0%} sure: {match.why})"
            reader.findings.info("other_layout", "", message, f"--layout {other.NAME} reads them so")
    report = CheckReport(
        layout=chosen[0].NAME,
        why=chosen[1].why,
        sureness=chosen[1].score,
        frames_found=reader.frames_found,
        frames_usable=len(manifest.frames) if manifest else 0,
        dropped=dict(reader.dropped),
        mesh=mesh.facts if mesh else None,
        view_size=_largest(manifest),
        findings=reader.findings.result(),
    )
    return ScanReading(manifest, report, mesh)


def _no_layout(archive: ScanArchive, layout: str | None, matches: list[tuple[Layout, Match]]) -> Finding:
    names = ", ".join(LAYOUT_NAMES)
    if layout is not None and layout not in LAYOUT_NAMES:
        message = f"{layout[:40]!r} is no layout that this program knows"
        return Finding("error", "unknown_layout", "", message, f"choose one of {names}")
    if layout is not None:
        found = f"; they look like {matches[0][0].NAME}: {matches[0][1].why}" if matches else ""
        remedy = "leave the layout out, or give a scan of it"
        return Finding("error", "unknown_layout", "", f"the files are not laid out as {layout}{found}", remedy)
    streams = [name for name in archive.names() if name.lower().endswith(".r3d")]
    if streams:
        return Finding("error", "unknown_layout", streams[0], "is a scan by itself", "give this file, not its folder")
    if not archive.names():
        return Finding("error", "unknown_layout", "", "there are no files", "give the folder or zip of a scan")
    pictures = [name for name in archive.names() if name.lower().endswith(".exr")]
    if pictures:
        message = "is an OpenEXR image, and the files are no scan of a known layout"
        return Finding("error", "exr_image", pictures[0], message, EXR_REMEDY)
    kinds = {kind: sum(name.lower().endswith(ends) for name in archive.names()) for kind, ends in KINDS.items()}
    held = ", ".join(f"{count} {kind}" for kind, count in kinds.items() if count) or "nothing that could be one"
    remedy = (
        "give the whole export with its camera poses (of Polycam the raw data, of 3D Scanner App all data, of Record3D "
        f"the .r3d), or write a scan.json; known layouts are {names}"
    )
    return Finding("error", "unknown_layout", "", f"the files are no scan of a known layout; they hold {held}", remedy)


def _largest(manifest: ScanManifest | None) -> tuple[int, int]:
    cameras = [frame.color_intrinsics for frame in manifest.frames] if manifest else []
    return max(((c.width, c.height) for c in cameras), key=lambda size: size[0] * size[1], default=(0, 0))


def _usable(reader: ScanReader, manifest: ScanManifest) -> ScanManifest:
    names = Counter(frame.name for frame in manifest.frames)
    for name in (name for name, count in names.items() if count > 1):
        message = f"{names[name]} frames share this name"
        reader.findings.error("duplicate_frame", name, message, "give each frame its own name")
    checked = [check_frame(reader, frame) for frame in manifest.frames]
    frames = tuple(frame for frame in checked if frame)
    without_depth = [frame.name for frame in frames if frame.depth is None]
    if 0 < len(without_depth) < len(frames):
        for name in without_depth:
            reader.findings.info("no_depth", name, "has no depth image; depth is rendered from the mesh")
    if len(frames) < MIN_FRAMES:
        message = f"{len(frames)} frames can be used{_left_out(reader.dropped)}; at least {MIN_FRAMES} are needed"
        remedy = "add frames with color image and pose, or mend those that are named beside this"
        reader.findings.error("too_few_frames", "", message, remedy)
    return replace(manifest, frames=frames)


def _left_out(dropped: Mapping[str, int]) -> str:
    reasons = ", ".join(f"{count} {reason.replace('_', ' ')}" for reason, count in sorted(dropped.items()))
    return f" (left out: {reasons})" if reasons else ""


def _check_mesh(reader: ScanReader, manifest: ScanManifest, arithmetic: Arithmetic) -> MeshSurface | None:
    if manifest.mesh is None:
        _report_no_mesh(reader, manifest)
        return None
    reader.used.add(manifest.mesh.path)
    try:
        mesh = read_mesh(reader.archive, manifest.mesh.path, arithmetic)
    except ScanFormatError as error:
        reader.findings.extend(error.findings)
        return None
    reader.used.update(mesh.files)
    check_sight(reader.findings, manifest, mesh)
    return mesh


def _report_no_mesh(reader: ScanReader, manifest: ScanManifest) -> None:
    if reader.mesh_reported:
        return
    if any(frame.depth is not None for frame in manifest.frames):
        reader.findings.info("mesh_fused", "", "there is no mesh; it will be fused from the depth images")
        return
    remedy = (
        "add the scan's reconstruction as mesh.ply, .obj or .glb, in the coordinates of the poses (scan.json names it "
        'as "mesh"), or depth images, which it is fused from'
    )
    reader.findings.error("no_mesh", "", "there is neither a mesh nor depth", remedy)


def _report_ignored(reader: ScanReader) -> None:
    for name in reader.archive.names():
        if name not in reader.used:
            reader.findings.info("ignored_file", name, "is no part of the layout and is not used")
