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
from advtex_scan.layouts import LAYOUTS, ScanReader, detect_layout
from advtex_scan.manifest import ScanManifest
from advtex_scan.mesh import MeshFacts, read_mesh

MIN_FRAMES = 3


@dataclass(frozen=True, slots=True)
class CheckReport:
    """What was found in a scan.

    layout, why: the layout's name and what gave it away; empty if none was recognized
    frames_found, frames_usable: in the files, and left after dropped and broken ones
    dropped: frames left out, by reason
    view_size: width and height of the largest color image, pixels
    """

    layout: str = ""
    why: str = ""
    frames_found: int = 0
    frames_usable: int = 0
    dropped: Mapping[str, int] = field(default_factory=dict)
    mesh: MeshFacts | None = None
    view_size: tuple[int, int] = (0, 0)
    findings: tuple[Finding, ...] = ()

    @property
    def ok(self) -> bool:
        """True if the scan can be textured: nothing of severity `error` was found."""
        return not any(finding.severity == "error" for finding in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """The report as JSON-ready values, `ok` included."""
        return {
            "ok": self.ok,
            "layout": self.layout,
            "why": self.why,
            "frames_found": self.frames_found,
            "frames_usable": self.frames_usable,
            "dropped": dict(self.dropped),
            "mesh": asdict(self.mesh) if self.mesh else None,
            "view_size": list(self.view_size),
            "findings": [asdict(finding) for finding in self.findings],
        }

    def format_text(self) -> str:
        """The report for people, without a final line break."""
        lines = [f"layout   {self.layout} ({self.why})" if self.layout else "layout   not recognized"]
        lines.append(f"frames   {self.frames_usable} usable of {self.frames_found}{_left_out(self.dropped)}")
        lines.append(f"mesh     {self.mesh.describe()}" if self.mesh else "mesh     none")
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
    could make anything of the files.
    """

    manifest: ScanManifest | None
    report: CheckReport


def check_scan(scan: str | os.PathLike[str] | ScanArchive) -> CheckReport:
    """Report on a folder, a zip or an open archive. Never raises for what is wrong with the scan."""
    if isinstance(scan, ScanArchive):
        return read_scan(scan).report
    try:
        with open_scan(scan) as archive:
            return read_scan(archive).report
    except ScanFormatError as error:
        return CheckReport(findings=error.findings)
    except OSError as error:
        message = f"cannot be read ({error.strerror})"
        return CheckReport(findings=(Finding("error", "unreadable_file", Path(scan).name, message, "check it"),))


def read_scan(archive: ScanArchive) -> ScanReading:
    """Read an archive's manifest and check all that can be checked without decoding images.

    Nothing that is wrong with the scan raises; it is in the report.
    """
    detected = detect_layout(archive)
    if detected is None:
        names = ", ".join(layout.NAME for layout in LAYOUTS)
        remedy = f"write a scan.json, or use one of the layouts {names}"
        message = "the files are of no known layout" if archive.names() else "there are no files"
        finding = Finding("error", "unknown_layout", "", message, remedy)
        return ScanReading(None, CheckReport(findings=(finding,)))
    layout, match = detected
    reader = ScanReader(archive)
    manifest = layout.read(reader)
    facts = None
    if manifest is not None:
        manifest = _usable(reader, manifest)
        facts = _check_mesh(reader, manifest)
        _report_ignored(reader)
    report = CheckReport(
        layout=layout.NAME,
        why=match.why,
        frames_found=reader.frames_found,
        frames_usable=len(manifest.frames) if manifest else 0,
        dropped=dict(reader.dropped),
        mesh=facts,
        view_size=_largest(manifest),
        findings=reader.findings.result(),
    )
    return ScanReading(manifest, report)


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


def _check_mesh(reader: ScanReader, manifest: ScanManifest) -> MeshFacts | None:
    if manifest.mesh is None:
        if not reader.mesh_reported:
            remedy = (
                "add the scan's reconstruction as mesh.ply, .obj or .glb, in the coordinates of the poses; "
                'scan.json names it as "mesh"'
            )
            reader.findings.error("no_mesh", "", "there is no mesh", remedy)
        return None
    reader.used.add(manifest.mesh.path)
    try:
        mesh = read_mesh(reader.archive, manifest.mesh.path)
    except ScanFormatError as error:
        reader.findings.extend(error.findings)
        return None
    reader.used.update(mesh.files)
    check_sight(reader.findings, manifest, mesh)
    return mesh.facts


def _report_ignored(reader: ScanReader) -> None:
    for name in reader.archive.names():
        if name not in reader.used:
            reader.findings.info("ignored_file", name, "is no part of the layout and is not used")
