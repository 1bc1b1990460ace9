"""Which other convention fits a sample of a scan clearly better than the one that its layout states.

What fits as it is, is left alone: an alternative is looked for where agreement is poor, and it has to be better by far,
since real scans agree with themselves to some percent only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor

from advtex_engine.conventions.readings import (
    Agreement,
    Reading,
    color_agreement,
    depth_agreement,
    inverse,
    mesh_agreement,
    render,
    surface,
)
from advtex_engine.conventions.sample import Sample
from advtex_engine.core.scene import Mesh
from advtex_engine.ingest.depth import PLAIN, ROTATED, DepthEncoding

GOOD_SHARE = 0.5
"""Share of the depths that agree from which on poses, units and the mesh's place are beyond doubt."""
GOOD_RELATIVE = 0.006
"""Median difference, as a share of the depth, at which nothing is left to find about the depth camera."""
CLEAR_GAIN = 0.25
"""Share of the depths, or correlation of the colors, that an alternative of another kind must add."""
COST_OF_CHANGE = 0.1
"""Share of the depths by which two changes at once must be better than one."""
CLEAR_RATIO = 2.0
"""Else the median difference must fall by this factor."""
GOOD_COLOR = 0.6
"""Correlation of the colors from which on the color camera's intrinsics are beyond doubt."""
COLOR_GAIN = 0.15
"""Correlation that others must add. On sound scans the best ones add up to 0.11; color that is taken as registered and
is not costs 0.25 and more."""
OFF_CENTER = 0.1
"""Share of the image by which a principal point is off its middle, for which there must be a reason."""
FOCAL_STEP = 1.075
FOCAL_STEPS = 4
"""Focal lengths are tried in steps by this factor, as many up and down; colors stop correlating 7 % off."""
FOCAL_REFINEMENTS = (1.035, 1.018)

Code = Literal[
    "camera_axes",
    "inverted_poses",
    "depth_unit",
    "ray_depth",
    "depth_intrinsics",
    "mesh_place",
    "color_not_registered",
    "color_intrinsics",
]

ENCODINGS = (
    *PLAIN,
    *ROTATED,
    DepthEncoding("quarters of a millimetre", 4_000.0),
    DepthEncoding("centimetres", 100.0),
    DepthEncoding("metres", 1.0),
)
_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


@dataclass(frozen=True)
class PoseConvention:
    """What a file's pose matrices are."""

    world_to_camera: bool = False
    opengl: bool = False

    def stored(self, camera_to_world: Tensor) -> Tensor:
        """OpenCV camera-to-world [N,4,4] as the files have it."""
        poses = camera_to_world @ _FLIP if self.opengl else camera_to_world
        return inverse(poses) if self.world_to_camera else poses

    def read(self, stored: Tensor) -> Tensor:
        """The inverse of `stored`."""
        poses = inverse(stored) if self.world_to_camera else stored
        return poses @ _FLIP if self.opengl else poses

    def __str__(self) -> str:
        direction = "world-to-camera" if self.world_to_camera else "camera-to-world"
        return f"{direction} with {'OpenGL' if self.opengl else 'OpenCV'} axes"


POSE_CONVENTIONS = tuple(PoseConvention(inverted, opengl) for inverted in (False, True) for opengl in (False, True))

_MESH_PLACES: dict[str, tuple[tuple[float, float, float], ...]] = {
    "in millimetres": ((1e-3, 0, 0), (0, 1e-3, 0), (0, 0, 1e-3)),
    "in centimetres": ((1e-2, 0, 0), (0, 1e-2, 0), (0, 0, 1e-2)),
    "with y up where the poses have z up": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "with z up where the poses have y up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "with y and z reversed": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
}


@dataclass(frozen=True)
class Evidence:
    """What speaks for a reading; each is None where the scan lacks what it takes.

    neighbors: depth between neighboring views. mesh: depth against the mesh. color: correlation of neighboring views.
    """

    neighbors: Agreement | None
    mesh: Agreement | None
    color: float | None = None

    @property
    def depths(self) -> list[Agreement]:
        return [one for one in (self.neighbors, self.mesh) if one is not None]

    @property
    def share(self) -> float:
        """Mean share of the depths that agree."""
        return sum(one.share for one in self.depths) / max(len(self.depths), 1)

    @property
    def relative(self) -> float:
        """Mean of the median differences, as a share of the depth."""
        found = [1.0 if one.relative is None else one.relative for one in self.depths]
        return sum(found) / max(len(found), 1)

    @property
    def good(self) -> bool:
        return all(one.share >= GOOD_SHARE for one in self.depths)


@dataclass(frozen=True)
class Fault:
    """A convention that fits clearly better. value: what it is, as far as there is more to say than its code."""

    code: Code
    value: Any
    before: Evidence
    after: Evidence


@dataclass(frozen=True)
class Outcome:
    """given: as the layout says. used: as the engine reads it, which finds out the unit of depth by the mesh."""

    given: Evidence
    used: Evidence
    faults: tuple[Fault, ...]


def search(sample: Sample, convention: PoseConvention) -> Outcome:
    """convention: of the poses in the files, as the layout states it."""
    given = used = _with_color(sample.reading, _depths(sample.reading))
    reading, faults = sample.reading, list[Fault]()
    if reading.depth is None:
        reading, found = _poses_by_color(reading, convention, given)
        faults += found
    else:
        reading, found = _poses_and_unit(sample, convention, given)
        faults += found
        if reading.mesh is not None and [fault.code for fault in found] == ["depth_unit"]:
            used = _with_color(reading, found[0].after)
        for look in (_mesh_place, _depth_camera):
            reading, found = look(reading)
            faults += found
    faults += _color_camera(reading, any(fault.code == "depth_intrinsics" for fault in faults))
    return Outcome(given, used, tuple(faults))


def _depths(reading: Reading, rendered: Tensor | None = None) -> Evidence:
    """How well the depths alone agree. rendered: the mesh, if it has been rendered into the depth cameras already."""
    if reading.depth is None:
        return Evidence(None, None)
    if reading.mesh is None:
        return Evidence(depth_agreement(reading), None)
    if rendered is None:
        rendered = render(reading, reading.depth_poses, reading.depth_intrinsics)
    return Evidence(depth_agreement(reading), mesh_agreement(reading, rendered))


def _with_color(reading: Reading, evidence: Evidence) -> Evidence:
    seen = surface(reading, of_mesh=reading.mesh is not None and not evidence.good)
    return replace(evidence, color=color_agreement(reading, seen))


def _clear(better: Evidence, than: Evidence) -> bool:
    """Whether the depths speak for another reading without doubt."""
    if better.share >= max(than.share + CLEAR_GAIN, GOOD_SHARE):
        return True
    return better.share >= max(than.share, GOOD_SHARE) and than.relative >= CLEAR_RATIO * better.relative


def _poses_and_unit(sample: Sample, convention: PoseConvention, given: Evidence) -> tuple[Reading, list[Fault]]:
    """Poses and unit of depth, together: neither can be judged while the other is wrong."""
    reading = sample.reading
    if given.good:
        return reading, []
    encodings = [sample.encoding, *(one for one in ENCODINGS if not _same(one, sample.encoding))]
    depths = [sample.metres(encoding) for encoding in encodings]
    stored = convention.stored(reading.camera_to_world)
    found = list[tuple[float, PoseConvention, DepthEncoding, Reading, Evidence]]()
    for poses in sorted(POSE_CONVENTIONS, key=lambda one: one != convention):
        posed = replace(reading, camera_to_world=poses.read(stored))
        rendered = None if posed.mesh is None else render(posed, posed.depth_poses, posed.depth_intrinsics)
        for encoding, depth in zip(encodings, depths, strict=True):
            candidate = replace(posed, depth=depth)
            evidence = _depths(candidate, rendered)
            changes = (poses != convention) + (encoding is not sample.encoding)
            found.append((evidence.share - COST_OF_CHANGE * changes, poses, encoding, candidate, evidence))
    _, poses, encoding, best, evidence = max(found, key=lambda one: one[0])
    if not _clear(evidence, given):
        return reading, []
    after = _with_color(best, evidence)
    faults = []
    if poses != convention:
        code: Code = "camera_axes" if poses.world_to_camera == convention.world_to_camera else "inverted_poses"
        faults.append(Fault(code, poses, given, after))
    if encoding is not sample.encoding:
        faults.append(Fault("depth_unit", encoding, given, after))
    return best, faults


def _same(one: DepthEncoding, other: DepthEncoding) -> bool:
    return (one.units_per_metre, one.rotated) == (other.units_per_metre, other.rotated)


def _poses_by_color(reading: Reading, convention: PoseConvention, given: Evidence) -> tuple[Reading, list[Fault]]:
    """Poses of a scan without depth: the mesh that the right ones see has the same colors in neighboring views."""
    if reading.mesh is None:
        return reading, []
    stored = convention.stored(reading.camera_to_world)
    best, poses, most = reading, convention, given.color or 0.0
    for other in POSE_CONVENTIONS:
        candidate = replace(reading, camera_to_world=other.read(stored))
        color = None if other == convention else color_agreement(candidate, surface(candidate))
        if color is not None and color >= max(most, (given.color or 0.0) + CLEAR_GAIN):
            best, poses, most = candidate, other, color
    if poses == convention:
        return reading, []
    code: Code = "camera_axes" if poses.world_to_camera == convention.world_to_camera else "inverted_poses"
    return best, [Fault(code, poses, given, Evidence(None, None, most))]


def _mesh_place(reading: Reading) -> tuple[Reading, list[Fault]]:
    """Where the mesh is, if the depth images agree with each other and not with it."""
    given = _depths(reading)
    if reading.mesh is None or given.neighbors is None or given.neighbors.share < GOOD_SHARE or given.good:
        return reading, []
    found = list[tuple[Evidence, str, Reading]]()
    for words, matrix in _MESH_PLACES.items():
        v_pos = reading.mesh.v_pos @ torch.tensor(matrix).float().T
        candidate = replace(reading, mesh=Mesh(v_pos, reading.mesh.t_pos_idx))
        found.append((_depths(candidate), words, candidate))
    evidence, words, best = max(found, key=lambda one: one[0].share)
    if not _clear(evidence, given):
        return replace(reading, mesh=None), []  # it says nothing about the cameras
    return best, [Fault("mesh_place", words, given, _with_color(best, evidence))]


def _depth_camera(reading: Reading) -> tuple[Reading, list[Fault]]:
    """What the depth camera measures, and its intrinsics."""
    given = _depths(reading)
    if given.relative <= GOOD_RELATIVE or reading.depth is None:
        return reading, []
    alternatives: list[tuple[Code, Any, Reading]] = [
        ("ray_depth", None, replace(reading, depth=reading.depth / _ray_lengths(reading))),
        *(
            ("depth_intrinsics", words, replace(reading, depth_intrinsics=K))
            for words, K in _other_cameras(reading.depth_intrinsics, reading.depth.shape[-1])
        ),
    ]
    factor = _best_focal(partial(_depth_score, reading))
    alternatives.append(
        ("depth_intrinsics", factor, replace(reading, depth_intrinsics=_focal(reading.depth_intrinsics, factor)))
    )
    judged = [(_depths(candidate), code, value, candidate) for code, value, candidate in alternatives]
    evidence, code, value, best = min(judged, key=lambda one: one[0].relative)
    if not _clear(evidence, given):
        return reading, []
    return best, [Fault(code, value, given, _with_color(best, evidence))]


def _depth_score(reading: Reading, factor: float) -> float:
    """How well neighboring views agree with other focal lengths; without the mesh, which would have to be rendered."""
    return depth_agreement(replace(reading, depth_intrinsics=_focal(reading.depth_intrinsics, factor))).share


def _color_camera(reading: Reading, depth_was_wrong: bool) -> list[Fault]:
    """The color camera's intrinsics, as surfaces that are seen twice tell them."""
    if reading.depth is None and reading.mesh is None:
        return []
    seen = surface(reading)
    given = color_agreement(reading, seen)
    if given is None or given >= GOOD_COLOR:
        return []
    measured = reading.depth is not None  # else the surface is the mesh as these very intrinsics see it

    def score(K: Tensor) -> float:
        candidate = replace(reading, color_intrinsics=K)
        return color_agreement(candidate, seen if measured else surface(candidate)) or 0.0

    factor = _best_focal(lambda factor: score(_focal(reading.color_intrinsics, factor)))
    alternatives: list[tuple[Any, Tensor]] = [(factor, _focal(reading.color_intrinsics, factor))]
    alternatives += _other_cameras(reading.color_intrinsics, reading.color.shape[-1])
    most, value = max(((score(K), value) for value, K in alternatives), key=lambda one: one[0])
    if most < given + COLOR_GAIN:
        return []
    registered = (
        measured
        and not depth_was_wrong
        and torch.allclose(reading.color_intrinsics, reading.depth_intrinsics, rtol=1e-3)
    )
    code: Code = "color_not_registered" if registered else "color_intrinsics"
    evidence = _depths(reading)
    return [Fault(code, value, replace(evidence, color=given), replace(evidence, color=most))]


def _ray_lengths(reading: Reading) -> Tensor:
    """Length [N,H,W] of the ray to each pixel's centre at depth 1."""
    height, width = reading.color.shape[1:]
    fx, fy, cx, cy = (reading.depth_intrinsics[:, k, None, None].float() for k in range(4))
    x, y = (torch.arange(width) + 0.5 - cx) / fx, (torch.arange(height)[:, None] + 0.5 - cy) / fy
    return (x**2 + y**2 + 1).sqrt()


def _other_cameras(K: Tensor, width: int) -> Iterable[tuple[str, Tensor]]:
    """Intrinsics [N,4] that bring a principal point to the middle of the image, if it is far from there."""
    middle = 2 * float(K[0, 2]) / width
    if abs(middle - 1) <= 2 * OFF_CENTER:
        return
    yield "for another size of the image", K / middle
    yield "with width and height swapped", K[:, [1, 0, 3, 2]]


def _focal(K: Tensor, factor: float) -> Tensor:
    return K * K.new_tensor([factor, factor, 1, 1])


def _best_focal(score: Callable[[float], float]) -> float:
    """The factor of the focal lengths that scores best: steps of FOCAL_STEP, then ever finer ones."""
    scores = {factor: score(factor) for factor in (FOCAL_STEP**step for step in range(-FOCAL_STEPS, FOCAL_STEPS + 1))}
    for step in FOCAL_REFINEMENTS:
        best = max(scores, key=lambda factor: scores[factor])
        scores |= {factor: score(factor) for factor in (best / step, best * step)}
    return max(scores, key=lambda factor: scores[factor])
