"""COLMAP: a sparse model, `cameras` and `images` as .bin or .txt in `sparse/0/` or elsewhere, and the model's images.

Poses are world-to-camera with OpenCV axes, in units of the model's own; the mesh must be in the same. The images lie in
`images/` or `input/` beside the model or above it. There is no depth: it is rendered from the mesh. Cameras of the
models SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV and FULL_OPENCV up to k3 are read; the image's corner is
at (0, 0). Of several models the undistorted one (`dense/`, or with `stereo/` beside it) is taken, else the largest.
Mesh: COLMAP's meshed-poisson.ply or meshed-delaunay.ply, mesh.ply, else the one mesh that is there.
"""

from __future__ import annotations

import math
from dataclasses import replace

from advtex_scan.archive import ScanArchive
from advtex_scan.errors import ScanFormatError
from advtex_scan.layouts._colmap_model import ModelCamera, ModelImage, read_cameras, read_images
from advtex_scan.layouts._mesh_choice import choose_mesh
from advtex_scan.layouts._reader import Match, ScanReader
from advtex_scan.layouts._sequences import by_name, padded
from advtex_scan.manifest import Distortion, FrameEntry, Intrinsics, Matrix4, ScanManifest
from advtex_scan.matrices import from_quaternion, invert_rigid, up_axis_of

NAME = "colmap"
SUFFIXES = (".bin", ".txt")
IMAGE_FOLDERS = ("images/", "input/", "")
MAX_MODELS = 100  # that are looked at; a failing reconstruction falls into dozens
TRIED_IMAGES = 50  # to find the folder that they lie in
MESH_NAMES = ("meshed-poisson.ply", "meshed-delaunay.ply")
OTHER_FILES = ("points3D", "rigs", "frames", "project.ini")  # of a model, not needed
UNIT_TOLERANCE = 0.01  # of a quaternion's length


def detect(archive: ScanArchive) -> Match | None:
    """Look for `cameras.*` and `images.*` in one folder."""
    models = _models(archive)
    return Match(0.7, f"{models[0][0]} and {models[0][1].rpartition('/')[2]} are there") if models else None


def read(reader: ScanReader) -> ScanManifest | None:
    """Read all images of the model that are there."""
    models = _models(reader.archive)
    if not models:
        return None
    camera_file, image_file = models[0]
    _report_models(reader, models)
    try:
        stated = read_cameras(reader.archive, camera_file)
        images = list(read_images(reader.archive, image_file))
    except ScanFormatError as error:
        reader.findings.extend(error.findings)
        return None
    reader.frames_found = len(images)
    cameras = {identity: _camera(reader, camera, identity, camera_file) for identity, camera in stated.items()}
    folder = _image_folder(reader.archive, image_file, images)
    entries = [_frame(reader, image, folder, cameras, image_file) for image in images]
    frames = by_name(entry for entry in entries if entry)
    meshes = [name for name in reader.archive.names() for end in MESH_NAMES if name.endswith(end)]
    return ScanManifest(
        layout=NAME,
        frames=frames,
        mesh=choose_mesh(reader, ("mesh.ply", *sorted(meshes, reverse=True))),
        up_axis=up_axis_of(frame.camera_to_world for frame in frames),
    )


def _models(archive: ScanArchive) -> list[tuple[str, str]]:
    """Return the camera and image files of all models, the one to be taken first."""
    models = []
    folders = {name[: name.rfind("/") + 1] for name in archive.names()}
    for folder in sorted(folders):
        cameras, images = (
            next((folder + kind + suffix for suffix in SUFFIXES if folder + kind + suffix in archive), None)
            for kind in ("cameras", "images")
        )
        if cameras and images:
            above = folder[: folder.rfind("/", 0, -1) + 1]
            undistorted = "dense" in folder.split("/") or any(name.startswith(f"{above}stereo/") for name in folders)
            models.append((not undistorted, -archive.size(images), cameras, images))
            if len(models) == MAX_MODELS:
                break
    return [(cameras, images) for _, _, cameras, images in sorted(models)]


def _report_models(reader: ScanReader, models: list[tuple[str, str]]) -> None:
    for cameras, images in models:
        folder = images.removesuffix(images.rpartition("/")[2])
        others = [folder + name + suffix for name in OTHER_FILES for suffix in (*SUFFIXES, "")]
        others += [folder + name + suffix for name in ("cameras", "images") for suffix in SUFFIXES]
        reader.used.update(name for name in others if name in reader.archive)
        if (cameras, images) != models[0]:
            message = f"is another model; {models[0][1]} is taken"
            reader.findings.info("other_model", images, message, "take the folder of one model to choose another")


def _image_folder(archive: ScanArchive, image_file: str, images: list[ModelImage]) -> str:
    """Return the folder where most of the first images are, searched from the model's folder upwards."""
    parts = image_file.split("/")[:-1]
    above = ["".join(f"{part}/" for part in parts[:count]) for count in range(len(parts), -1, -1)]
    folders = [start + folder for start in above for folder in IMAGE_FOLDERS]
    names = [image.name for image in images[:TRIED_IMAGES]]
    return max(folders, key=lambda folder: sum(folder + name in archive for name in names))


def _frame(
    reader: ScanReader, image: ModelImage, folder: str, cameras: dict[int, Intrinsics | None], where: str
) -> FrameEntry | None:
    path = folder + image.name
    if path not in reader.archive:
        remedy = "add the images under the names that the model has for them"
        reader.drop("missing_color", path[:200], "is in the model but not there; the frame is left out", remedy)
        return None
    reader.used.add(path)
    if image.camera not in cameras:
        message = f"has the camera {image.camera}, which the model does not describe"
        reader.findings.error("bad_colmap", path, message, "export the model again with COLMAP")
        return None
    pose, camera = _pose(reader, image, f"{where}: {path}"), cameras[image.camera]
    if pose is None or camera is None:
        return None
    stem = image.name.rpartition(".")[0] or image.name
    return FrameEntry(padded(stem), path, None, pose, camera)


def _pose(reader: ScanReader, image: ModelImage, where: str) -> Matrix4 | None:
    length = math.hypot(*image.quaternion)
    if not abs(length - 1) <= UNIT_TOLERANCE:
        message = f"its quaternion has the length {length:.3g}, not 1"
        reader.findings.error("bad_pose", where, message, "export the model again with COLMAP")
        return None
    w, x, y, z = (value / length for value in image.quaternion)
    rows = from_quaternion(x, y, z, w, image.translation)
    world_to_camera = reader.pose([value for row in rows for value in row], where)
    return invert_rigid(world_to_camera) if world_to_camera else None


def _camera(reader: ScanReader, camera: ModelCamera, identity: int, path: str) -> Intrinsics | None:
    """Return the pinhole and the distortion of a camera; None, with a finding, for models of other lenses."""
    where, values = f"{path}: camera {identity}", camera.parameters
    if camera.model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        values = (values[0], *values)
    elif camera.model not in ("PINHOLE", "OPENCV", "FULL_OPENCV"):
        message = f"is of the model {camera.model}, which is not supported"
        remedy = "undistort the images with `colmap image_undistorter` and give its output folder"
        reader.findings.error("camera_model", where, message, remedy)
        return None
    if any(values[9:]):
        remedy = "undistort the images with `colmap image_undistorter` and give its output folder"
        reader.findings.error("camera_model", where, "has distortion beyond k3, which is not supported", remedy)
        return None
    fx, fy, cx, cy, *bent = values
    found = reader.intrinsics((fx, fy, cx, cy), (camera.width, camera.height), where)
    if found is None or not any(bent):
        return found
    if not all(map(math.isfinite, bent)):
        reader.findings.error("bad_intrinsics", where, "has infinite distortion", "export the model again with COLMAP")
        return None
    return replace(found, distortion=Distortion(*bent[:5]))
