"""Whether mesh and cameras belong together: a cheap test with points spread over the mesh."""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import replace
from itertools import accumulate

from advtex_scan.errors import Findings
from advtex_scan.manifest import IDENTITY, FrameEntry, ScanManifest
from advtex_scan.matrices import compose, invert_rigid
from advtex_scan.mesh import MeshSurface, Vector

SAMPLED_TRIANGLES = 20_000
SAMPLED_POINTS = 2_000
SAMPLED_FRAMES = 200
NEAR = 0.01  # metres
FAR_FACTOR = 20.0  # cameras further from the mesh's box than this many of its diagonals are in another place or unit
LARGE_MESH = 200.0  # metres; a hand-held scan is smaller
GOLDEN = 0.6180339887498949


def check_sight(findings: Findings, manifest: ScanManifest, mesh: MeshSurface) -> None:
    """Report cameras far from the mesh, and that none of them, or few, see it."""
    if not manifest.frames:
        return
    frames = _in_mesh_coordinates(manifest)
    low, high = mesh.facts.bounds
    diagonal = math.dist(low, high)
    distances = [_distance_to_box(_center(frame), low, high) for frame in frames]
    remedy = "bring both into one coordinate system and into metres, and check that poses are camera-to-world"
    if min(distances) > FAR_FACTOR * diagonal:
        message = f"the nearest camera is {min(distances):.2f} m away from a mesh of {diagonal:.2f} m"
        findings.error("mesh_far", mesh.facts.path, message, remedy)
    if diagonal > LARGE_MESH:
        message = f"measures {diagonal:.0f} m across"
        findings.warning("mesh_large", mesh.facts.path, message, "check that it is in metres, not in millimetres")
    step = -(-len(frames) // SAMPLED_FRAMES)
    tried = frames[::step]
    points = spread_points(mesh, SAMPLED_POINTS)
    blind = [frame.name for frame in tried if not sees(frame, points)]
    if len(blind) == len(tried):
        message = f"no frame sees the mesh ({len(tried)} were tried)"
        findings.error("mesh_unseen", mesh.facts.path, message, remedy)
    else:
        for name in blind:
            message = "does not see the mesh"
            findings.warning("frame_blind", name, message, "check its pose, or that the mesh is complete")


def _in_mesh_coordinates(manifest: ScanManifest) -> tuple[FrameEntry, ...]:
    """Return the frames as seen from the mesh's own coordinates."""
    if manifest.mesh is None or manifest.mesh.mesh_to_world == IDENTITY:
        return manifest.frames
    to_mesh = invert_rigid(manifest.mesh.mesh_to_world)
    return tuple(replace(frame, camera_to_world=compose(to_mesh, frame.camera_to_world)) for frame in manifest.frames)


def spread_points(mesh: MeshSurface, count: int) -> list[Vector]:
    """Return about `count` points on the mesh, spread by area over at most SAMPLED_TRIANGLES of its triangles."""
    triangles = range(0, mesh.facts.faces, -(-mesh.facts.faces // SAMPLED_TRIANGLES))
    ends = list(accumulate(mesh.area(triangle) for triangle in triangles))
    points = []
    for index in range(count):
        # The golden ratio visits the surface evenly from the first points on, so that a hit comes early.
        where = (index * GOLDEN % 1.0) * ends[-1]
        triangle = triangles[min(bisect_left(ends, where), len(ends) - 1)]
        s, t = math.sqrt((index * 0.7548776662 + 0.5) % 1.0), (index * 0.5698402910 + 0.5) % 1.0
        a, b, c = (mesh.corner(3 * triangle + corner) for corner in range(3))
        wa, wb, wc = 1 - s, s * (1 - t), s * t
        points.append(
            (
                wa * a[0] + wb * b[0] + wc * c[0],
                wa * a[1] + wb * b[1] + wc * c[1],
                wa * a[2] + wb * b[2] + wc * c[2],
            )
        )
    return points


def sees(frame: FrameEntry, points: list[Vector]) -> bool:
    """Tell whether any of the world points projects into the color image, in front of the camera."""
    r0, r1, r2, _ = invert_rigid(frame.camera_to_world)
    K = frame.color_intrinsics
    for x, y, z in points:
        depth = r2[0] * x + r2[1] * y + r2[2] * z + r2[3]
        if depth < NEAR:
            continue
        u = K.fx * (r0[0] * x + r0[1] * y + r0[2] * z + r0[3]) / depth + K.cx
        v = K.fy * (r1[0] * x + r1[1] * y + r1[2] * z + r1[3]) / depth + K.cy
        if 0 <= u <= K.width and 0 <= v <= K.height:
            return True
    return False


def _center(frame: FrameEntry) -> Vector:
    return frame.camera_to_world[0][3], frame.camera_to_world[1][3], frame.camera_to_world[2][3]


def _distance_to_box(point: Vector, low: Vector, high: Vector) -> float:
    outside = [max(a - p, 0.0, p - b) for p, a, b in zip(point, low, high, strict=True)]
    return math.hypot(*outside)
