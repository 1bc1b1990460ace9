"""Where the files of each layout state a convention, and what its poses are: the words of remedies."""

from __future__ import annotations

from dataclasses import dataclass

from advtex_engine.conventions.search import PoseConvention

_OPENCV = PoseConvention()
_OPENGL = PoseConvention(opengl=True)
_WORLD_TO_CAMERA = PoseConvention(world_to_camera=True)
_ELSEWHERE = "a scan.json"  # which states what the layout has no place for


@dataclass(frozen=True)
class Places:
    """Files, or keys in files. registration: of color intrinsics beside depth's, and of where the color camera is."""

    poses: str
    color_camera: str
    convention: PoseConvention = _OPENCV
    depth_camera: str = _ELSEWHERE
    registration: str = _ELSEWHERE
    depth_unit: str = _ELSEWHERE


PLACES = {
    "native": Places(
        "scan.json: camera_to_world",
        "scan.json: color_intrinsics",
        depth_camera="scan.json: depth_intrinsics",
        registration="scan.json: color_intrinsics, depth_to_color",
        depth_unit="scan.json: depth_scale",
    ),
    "seven_scenes": Places(
        "*.pose.txt",
        "color-intrinsics.txt",
        depth_camera="depth-intrinsics.txt",
        registration="color-intrinsics.txt, depth-to-color.txt",
        depth_unit="info.txt: m_depthShift",
    ),
    "scannet": Places(
        "pose/*.txt",
        "intrinsic/intrinsic_color.txt",
        depth_camera="intrinsic/intrinsic_depth.txt",
        registration="intrinsic/intrinsic_color.txt, <scene>.txt: colorToDepthExtrinsics",
    ),
    "sens": Places(
        "the .sens: camera to world",
        "the .sens: intrinsic color",
        depth_camera="the .sens: intrinsic depth",
        registration="<scene>.txt: colorToDepthExtrinsics",
        depth_unit="the .sens: depth shift",
    ),
    "mvs_cam": Places("*.cam", "intrinsics.txt: color", _WORLD_TO_CAMERA, depth_camera="intrinsics.txt: depth"),
    "nerfstudio": Places(
        "transforms.json: transform_matrix",
        "transforms.json: fl_x, fl_y, cx, cy",
        _OPENGL,
        depth_unit="transforms.json: integer_depth_scale (metres per unit)",
    ),
    "polycam": Places("cameras/*.json: t_00 to t_23", "cameras/*.json: fx, fy, cx, cy", _OPENGL),
    "record3d": Places("metadata: poses", "metadata: K, perFrameIntrinsicCoeffs", _OPENGL),
    "scanner_app": Places("frame_*.json: cameraPoseARFrame", "frame_*.json: intrinsics", _OPENGL),
    "stray_scanner": Places("odometry.csv", "camera_matrix.csv"),
    "tum": Places("groundtruth.txt", "camera-intrinsics.txt"),
    "redwood": Places("the trajectory", "camera-intrinsics.txt"),
    "replica": Places("traj.txt", "cam_params.json", depth_unit="cam_params.json: scale"),
    "sun3d": Places("extrinsics/*.txt", "intrinsics.txt"),
    "arkitscenes": Places("lowres_wide.traj", "*.pincam", _WORLD_TO_CAMERA),
    "colmap": Places("images.txt or images.bin", "cameras.txt or cameras.bin", _WORLD_TO_CAMERA),
}
