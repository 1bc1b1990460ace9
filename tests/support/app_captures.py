"""Scans as phone apps export them, from known cameras. `make` is the maker of images from the tests of scans."""

from __future__ import annotations

import io
import json
import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from advtex_scan import Intrinsics

Files = dict[str, bytes]
Pose = np.ndarray
WIDTH, HEIGHT = 32, 24
DEPTH_WIDTH, DEPTH_HEIGHT = 16, 12
PINHOLE = (30.0, 31.0, 16.25, 11.75)
GL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Capture:
    """What an app recorded: poses (camera-to-world, OpenCV axes), and the same camera for all."""

    poses: Sequence[Pose]
    pinhole: tuple[float, float, float, float] = PINHOLE


def quaternion(rotation: np.ndarray) -> list[float]:
    """x y z w: the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    K = np.array(
        [
            [a - e - i, b + d, c + g, h - f],
            [b + d, e - a - i, f + h, c - g],
            [c + g, f + h, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    return np.linalg.eigh(K)[1][:, -1].tolist()


def gray(make, width: int = DEPTH_WIDTH, height: int = DEPTH_HEIGHT) -> bytes:
    return make.png(width, height, 8, 0)


def depth(make) -> bytes:
    return make.depth_png(DEPTH_WIDTH, DEPTH_HEIGHT)


def lzfse(content: bytes) -> bytes:
    """A stream of one block that is not compressed."""
    return b"bvx-" + struct.pack("<I", len(content)) + content + b"bvx$"


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def mp4(frames: int, width: int = WIDTH, height: int = HEIGHT, first: bytes = b"vide") -> bytes:
    """The boxes that say what a video holds, after its data; a sound track comes before the pictures."""

    def box(kind: bytes, *parts: bytes) -> bytes:
        body = b"".join(parts)
        return struct.pack(">I4s", 8 + len(body), kind) + body

    def track(handler: bytes, count: int) -> bytes:
        entry = box(b"hvc1", bytes(24), struct.pack(">2H", width, height), bytes(50))
        table = box(b"stbl", box(b"stsd", bytes(7), b"\1", entry), box(b"stsz", bytes(8), struct.pack(">I", count)))
        return box(b"trak", box(b"mdia", box(b"hdlr", bytes(8), handler, bytes(12)), box(b"minf", table)))

    data = struct.pack(">I4sQ", 1, b"mdat", 116) + bytes(100)
    return (
        box(b"ftyp", b"qt  ") + data + box(b"moov", box(b"mvhd", bytes(100)), track(b"soun", 9), track(first, frames))
    )


def polycam(capture: Capture, make) -> Files:
    files: Files = {"mesh_info.json": json.dumps({"alignmentTransform": np.eye(4).T.ravel().tolist()}).encode()}
    for i, pose in enumerate(capture.poses):
        time = 824048931094 + 400_000 * i
        values = dict(zip(("fx", "fy", "cx", "cy"), capture.pinhole, strict=True)) | {"width": WIDTH, "height": HEIGHT}
        turned = pose @ GL
        values |= {f"t_{row}{column}": turned[row, column] for row in range(3) for column in range(4)}
        wrong = values | {"t_03": turned[0, 3] + 1}
        for kind, camera in (("corrected_", values | {"blur_score": 100.0 + i}), ("", wrong)):
            files[f"keyframes/{kind}cameras/{time}.json"] = json.dumps(camera).encode()
            files[f"keyframes/{kind}images/{time}.jpg"] = make.jpeg()
        files[f"keyframes/depth/{time}.png"], files[f"keyframes/confidence/{time}.png"] = depth(make), gray(make)
    return files


def record3d(capture: Capture, make) -> Files:
    fx, fy, cx, cy = capture.pinhole
    poses = [[*quaternion((pose @ GL)[:3, :3]), *pose[:3, 3].tolist()] for pose in capture.poses]
    metadata = {"w": WIDTH, "h": HEIGHT, "dw": DEPTH_WIDTH, "dh": DEPTH_HEIGHT, "poses": poses}
    metadata |= {"K": [9, 0, 0, 0, 9, 0, 9, 9, 1], "perFrameIntrinsicCoeffs": [[fx, fy, cx, cy]] * len(poses)}
    files = {"metadata": json.dumps(metadata).encode()}
    for i in range(len(poses)):
        files |= {f"rgbd/{i}.jpg": make.jpeg(), f"rgbd/{i}.depth": lzfse(bytes(4 * DEPTH_WIDTH * DEPTH_HEIGHT))}
        files[f"rgbd/{i}.conf"] = lzfse(bytes(DEPTH_WIDTH * DEPTH_HEIGHT))
    return files


def stray_scanner(capture: Capture, make) -> Files:
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy, distortion_center_x, distortion_center_y"]
    files: Files = {"rgb.mp4": mp4(len(capture.poses)), "camera_matrix.csv": b"99,0,9\n0,99,9\n0,0,1\n"}
    for i, pose in enumerate(capture.poses):
        numbers = [*pose[:3, 3].tolist(), *quaternion(pose[:3, :3]), *capture.pinhole]
        lines.append(", ".join([f"{i / 60}", f"{i:06d}", *map(repr, numbers), "", ""]))
        files[f"depth/{i:06d}.png"], files[f"confidence/{i:06d}.png"] = depth(make), gray(make)
    return files | {"odometry.csv": "\n".join(lines).encode()}


def scanner_app(capture: Capture, make) -> Files:
    fx, fy, cx, cy = capture.pinhole
    files: Files = {}
    for i, pose in enumerate(capture.poses):
        frame = {"cameraPoseARFrame": (pose @ GL).ravel().tolist(), "intrinsics": [fx, 0, cx, 0, fy, cy, 0, 0, 1]}
        files[f"frame_{i:05d}.json"] = json.dumps(frame | {"motionQuality": 0.5}).encode()
        files[f"frame_{i:05d}.jpg"] = make.jpeg()
        files[f"depth_{i:05d}.png"], files[f"conf_{i:05d}.png"] = depth(make), gray(make)
    return files


def nerfstudio(capture: Capture, make) -> Files:
    fx, fy, cx, cy = capture.pinhole
    frames = []
    files: Files = {}
    for i, pose in enumerate(capture.poses):
        files |= {f"images/frame_{i:05d}.jpg": make.jpeg(), f"depth/frame_{i:05d}.png": depth(make)}
        paths = {"file_path": f"./images/frame_{i:05d}.jpg", "depth_file_path": f"depth/frame_{i:05d}.png"}
        frames.append(paths | {"transform_matrix": (pose @ GL).tolist()})
    scan = {"camera_model": "OPENCV", "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": WIDTH, "h": HEIGHT}
    return files | {"transforms.json": json.dumps(scan | {"k1": 0, "p2": 0.0, "frames": frames}).encode()}


def instant_ngp(capture: Capture, make) -> Files:
    """Intrinsics in each frame, depth with a scale, suffixes left out as NeRFCapture does."""
    fx, fy, cx, cy = capture.pinhole
    frames = []
    files: Files = {}
    for i, pose in enumerate(capture.poses):
        files |= {f"images/{i}.png": make.png(), f"images/{i}.depth.png": depth(make)}
        frame = {"file_path": f"images/{i}", "depth_path": f"images/{i}.depth.png", "fl_x": fx, "fl_y": fy}
        frames.append(frame | {"cx": cx, "cy": cy, "transform_matrix": (pose @ GL).tolist()})
    scan = {"integer_depth_scale": 0.001, "aabb_scale": 16, "scale": 0.33, "offset": [1, 2, 3], "frames": frames}
    return files | {"transforms.json": json.dumps(scan).encode()}


WRITERS: dict[str, Callable[[Capture, object], Files]] = {
    "polycam": polycam,
    "record3d": record3d,
    "stray_scanner": stray_scanner,
    "scanner_app": scanner_app,
    "nerfstudio": nerfstudio,
    "instant_ngp": instant_ngp,
}
LAYOUT = {name: name for name in WRITERS} | {"instant_ngp": "nerfstudio"}


def circle(make, count: int = 12) -> Capture:
    """Cameras around a box that look at it."""
    return Capture([np.array(make.look_at(2 * math.pi * i / count)) for i in range(count)])


def check_cameras(manifest, capture: Capture) -> None:
    """Every frame has the capture's pose, and its camera for color and for the smaller depth images."""
    expected = Intrinsics(*capture.pinhole, WIDTH, HEIGHT)
    assert len(manifest.frames) == len(capture.poses)
    assert [frame.name for frame in manifest.frames] == sorted({frame.name for frame in manifest.frames})
    for frame, pose in zip(manifest.frames, capture.poses, strict=True):
        np.testing.assert_allclose(frame.camera_to_world, pose, atol=1e-9)
        assert frame.color_intrinsics == expected
        assert frame.depth_intrinsics == expected.scaled(DEPTH_WIDTH, DEPTH_HEIGHT)
        assert frame.depth is not None
