"""Whether a scan means what its layout says: axes, direction and unit of its numbers, measured on a few frames.

The report says how well depth, mesh and color agree with each other, and which other convention fits clearly better,
with the place in the scan's files where it is stated.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from advtex_engine.conventions.places import PLACES, Places
from advtex_engine.conventions.readings import AGREEMENT, Agreement
from advtex_engine.conventions.sample import Sample, take_sample
from advtex_engine.conventions.search import Evidence, Fault, Outcome, search
from advtex_engine.core.errors import Problem, ScanError
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Mesh
from advtex_engine.ingest.read import opened
from advtex_engine.mesh.read import NUMPY, to_mesh
from advtex_scan.archive import ScanArchive
from advtex_scan.check import read_scan
from advtex_scan.errors import ScanFormatError
from advtex_scan.manifest import MeshEntry, ScanManifest

HOPELESS_SHARE = 0.35
"""Share of agreeing depths below which they may as well agree by chance."""
HOPELESS_RELATIVE = 0.1
"""And the median difference, as a share of the depth, above which they do."""
HOPELESS_COLOR = 0.3
"""Correlation of colors that views of wrong cameras still reach, since walls are everywhere alike."""
LEAST_FRAMES = 2
_VERDICTS = ("no other convention fits clearly better", "mend this before texturing")


@dataclass(frozen=True)
class DeepCheck:
    """What was measured and what it says.

    problems: the faults, each with place and remedy. hopeless: nothing agrees with anything, as the engine reads it.
    """

    outcome: Outcome
    frames: int
    problems: tuple[Problem, ...]
    hopeless: bool

    def to_dict(self) -> dict[str, Any]:
        """The report as JSON-ready values."""
        return {
            "frames": self.frames,
            "summary": _words(self.outcome.given),
            "as_given": _figures(self.outcome.given),
            "as_used": _figures(self.outcome.used),
            "hopeless": self.hopeless,
            "faults": [
                {"code": fault.code, "before": _figures(fault.before), "after": _figures(fault.after)}
                for fault in self.outcome.faults
            ],
            "problems": [asdict(problem) for problem in self.problems],
        }

    def format_text(self) -> str:
        """The report for people, without a final line break."""
        lines = [f"measured on {self.frames} frames: {_words(self.outcome.given)}"]
        for problem in self.problems:
            lines += [f"{problem.where}: {problem.message}", f"    -> {problem.remedy}"]
        return "\n".join([*lines, _VERDICTS[self.hopeless or bool(self.problems)]])

    def reject(self) -> None:
        """Raises ScanError with the figures if the scan is hopeless."""
        if not self.hopeless:
            return
        message = f"nothing agrees with anything in {self.frames} frames: {_words(self.outcome.used)}"
        remedy = "bring poses, depth, intrinsics and mesh into the conventions of the layout"
        raise ScanError(*(self.problems or (Problem("nothing_agrees", "scan", message, remedy),)))


def deep_check(scan: Path, layout: str | None = None) -> DeepCheck | None:
    """Measures a scan (folder or zip); None if it has too little to be measured. Raises ScanError if it is broken."""
    with opened(scan) as archive:
        reading = read_scan(archive, layout, NUMPY)
        manifest = reading.manifest
        if manifest is None:
            raise ScanError(
                Problem("unknown_layout", scan.name, "is no scan of a known layout", "see `advtex-client check`")
            )
        mesh = None
        if manifest.mesh is not None:
            if reading.mesh is None:
                raise ScanFormatError(*(found for found in reading.report.findings if found.severity == "error"))
            mesh = _placed(to_mesh(reading.mesh), manifest.mesh)
        return check_conventions(archive, manifest, mesh)


def _placed(mesh: Mesh, entry: MeshEntry) -> Mesh:
    """The mesh in world coordinates."""
    transform = torch.tensor(entry.mesh_to_world)
    return Mesh(mesh.v_pos @ transform[:3, :3].T + transform[:3, 3], mesh.t_pos_idx)


def checked_conventions(
    scan: Path, manifest: ScanManifest, mesh: Mesh | None, monitor: Monitor
) -> dict[str, Any] | None:
    """`deep_check` of a scan that has been read: the report, and warnings. mesh: in world coordinates.

    Raises ScanError if the scan is hopeless.
    """
    with opened(scan) as archive:
        check = check_conventions(archive, manifest, mesh)
    if check is None:
        return None
    check.reject()
    for problem in check.problems:
        if problem.code != "depth_unit" or mesh is None:  # else ingest has found it out and told it
            monitor.warning(problem)
    return check.to_dict()


def check_conventions(archive: ScanArchive, manifest: ScanManifest, mesh: Mesh | None) -> DeepCheck | None:
    """`deep_check` of an open scan. mesh: in world coordinates.

    A mesh that is placed roughly, to be moved onto the depth, speaks neither for nor against a convention.
    """
    rough = manifest.mesh is not None and manifest.mesh.refinement != "none"
    if len(manifest.frames) < LEAST_FRAMES:
        return None
    sample = take_sample(archive, manifest, None if rough else mesh)
    if sample.reading.depth is None and sample.reading.mesh is None:
        return None
    places = PLACES[manifest.layout]
    outcome = search(sample, places.convention)
    problems = tuple(_problem(fault, sample, places) for fault in outcome.faults)
    return DeepCheck(outcome, len(sample.reading.color), problems, _hopeless(outcome))


def _hopeless(outcome: Outcome) -> bool:
    used = outcome.used
    depths = [one for one in used.depths if one.relative is not None]
    if any(one.share >= HOPELESS_SHARE or (one.relative or 0.0) <= HOPELESS_RELATIVE for one in depths):
        return False
    if used.color is not None and used.color >= HOPELESS_COLOR:
        return False
    poses = any(fault.code in ("camera_axes", "inverted_poses") for fault in outcome.faults)
    return bool(depths) or used.mesh is not None or used.color is not None or poses


def _problem(fault: Fault, sample: Sample, places: Places) -> Problem:
    where, message, remedy = _SENTENCES[fault.code](fault, sample, places)
    figures = f"so read, {_words(fault.after)}; as it stands, {_words(fault.before)}"
    return Problem(fault.code, where, f"{message}: {figures}", remedy)


Sentence = tuple[str, str, str]  # where, message, remedy


def _axes(fault: Fault, _sample: Sample, places: Places) -> Sentence:
    message = f"the poses seem to be {fault.value}; this layout's are {places.convention}"
    axes = "OpenGL (y up, z backward)" if places.convention.opengl else "OpenCV (y down, z forward)"
    remedy = f"write the poses with {axes} axes: change the sign of the second and third column of each camera-to-world"
    return places.poses, message, f"{remedy} matrix in {places.poses}"


def _inverted(fault: Fault, sample: Sample, places: Places) -> Sentence:
    message = f"the poses seem to be {fault.value}; this layout's are {places.convention}"
    remedy = f"invert each matrix in {places.poses}"
    if fault.value.opengl != places.convention.opengl:
        remedy += f", and {_axes(fault, sample, places)[2]}"
    return places.poses, message, remedy


def _unit(fault: Fault, sample: Sample, places: Places) -> Sentence:
    message = f"the depth images seem to hold {fault.value.name}, not {sample.encoding.name}"
    if fault.before.mesh is not None:
        return places.depth_unit, message, f"none needed with this mesh; else {_unit_remedy(fault, places)}"
    return places.depth_unit, message, _unit_remedy(fault, places)


def _unit_remedy(fault: Fault, places: Places) -> str:
    if fault.value.rotated:
        return "write the depth images again as plain millimetres"
    return f"state {fault.value.units_per_metre:g} units per metre in {places.depth_unit}"


def _ray(_fault: Fault, _sample: Sample, _places: Places) -> Sentence:
    message = "the depth seems to be measured along each pixel's ray, not along the camera's axis"
    return "depth images", message, "divide each reading by the length of (x, y, 1), its pixel's ray at depth 1"


def _depth_camera(fault: Fault, sample: Sample, places: Places) -> Sentence:
    camera = sample.depth_camera or sample.color_camera
    message = f"the depth camera's intrinsics seem to be {_camera_words(fault, camera.fx)}"
    return places.depth_camera, message, f"give the depth camera's own intrinsics in {places.depth_camera}"


def _color_camera(fault: Fault, sample: Sample, places: Places) -> Sentence:
    message = f"the color camera's intrinsics seem to be {_camera_words(fault, sample.color_camera.fx)}"
    return places.color_camera, message, f"give the color camera's own intrinsics in {places.color_camera}"


def _registration(fault: Fault, sample: Sample, places: Places) -> Sentence:
    fx = sample.color_camera.fx
    message = (
        "the color is not registered to the depth, whose intrinsics it was given: intrinsics "
        f"{_camera_words(fault, fx)}, fit it better"
    )
    remedy = f"give the color camera's intrinsics and its place beside the depth camera in {places.registration}"
    return places.registration, message, remedy


def _mesh(fault: Fault, _sample: Sample, _places: Places) -> Sentence:
    message = f"the mesh seems to be {fault.value}"
    return "mesh", message, "bring it into the poses' world, in metres, or give mesh_to_world in a scan.json"


_SENTENCES = {
    "camera_axes": _axes,
    "inverted_poses": _inverted,
    "depth_unit": _unit,
    "ray_depth": _ray,
    "depth_intrinsics": _depth_camera,
    "mesh_place": _mesh,
    "color_not_registered": _registration,
    "color_intrinsics": _color_camera,
}


def _camera_words(fault: Fault, focal: float) -> str:
    if isinstance(fault.value, str):
        return fault.value
    return f"of a focal length of about {fault.value * focal:.0f} pixels, not {focal:.0f}"


def _words(evidence: Evidence) -> str:
    found = []
    for name, one in (("neighboring views'", evidence.neighbors), ("the mesh's", evidence.mesh)):
        if one is not None:
            off = "" if one.metres is None else f" (median difference {one.metres:.3f} m)"
            found.append(f"{one.share:.0%} of the depth is within {AGREEMENT:.0%} of {name}{off}")
    if evidence.color is not None:
        found.append(f"colors of neighboring views correlate by {evidence.color:.2f}")
    return ", ".join(found) or "nothing can be compared"


def _figures(evidence: Evidence) -> dict[str, Any]:
    error = None if evidence.color is None else round(1 - evidence.color, 4)
    return {"depth": _rounded(evidence.neighbors), "mesh": _rounded(evidence.mesh), "photometric_error": error}


def _rounded(one: Agreement | None) -> dict[str, float | None] | None:
    if one is None:
        return None
    return {key: None if value is None else round(value, 5) for key, value in asdict(one).items()}
