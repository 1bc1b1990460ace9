"""How synthetic scans are written: whole or not at all, the same bytes from the same arguments."""

from __future__ import annotations

import os
import shutil
import tempfile
import zipfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from advtex_engine.core.errors import OptionError
from advtex_engine.core.scene import Camera, Mesh

MIN_VIEWS, MIN_SIDE = 3, 16
TRUTH = "truth/cameras.json"


def require_size(views: int, width: int, height: int) -> None:
    """OptionError for scans that nothing could be made of."""
    if views < MIN_VIEWS or min(width, height) < MIN_SIDE:
        raise OptionError(f"{views} views of {width}x{height} are too few or too small; at least 3 of 16x16 are needed")


@contextmanager
def new_scan(out: Path) -> Iterator[Path]:
    """The name of a folder to make and fill; at the end it is put at `out`, zipped if that ends in .zip.

    A folder at `out` is replaced if it is a synthetic scan, else OptionError is raised. An error leaves nothing.
    """
    if out.is_dir() and any(out.iterdir()) and not (out / TRUTH).is_file():
        raise OptionError(f"{out} holds something else than a synthetic scan; choose another folder or remove it")
    out.resolve().parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".advtex-synthesize-", dir=out.resolve().parent) as work:
        folder = Path(work) / "scan"
        yield folder
        if out.suffix == ".zip":
            _zip_folder(folder, Path(work) / "scan.zip")
            (Path(work) / "scan.zip").replace(out)
            return
        if out.exists():
            shutil.rmtree(out)
        folder.rename(out)


@contextmanager
def thread_per_view() -> Iterator[ThreadPoolExecutor]:
    """One thread per core, each with its own view: a view's tensors are too small to be shared among threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            yield pool
    finally:
        torch.set_num_threads(threads)


def intrinsics(camera: Camera) -> dict[str, float | int]:
    """A camera's K and size as `scan.json` has them."""
    K = camera.K
    return {
        "fx": float(K[0, 0]),
        "fy": float(K[1, 1]),
        "cx": float(K[0, 2]),
        "cy": float(K[1, 2]),
        "width": camera.width,
        "height": camera.height,
    }


def pose(name: str, matrix: NDArray[np.float64]) -> dict[str, Any]:
    """A frame's name and camera_to_world [4,4] as `scan.json` has them."""
    return {"name": name, "camera_to_world": matrix.tolist()}


def write_png(path: Path, image: NDArray[Any]) -> None:
    """A gray or RGB image."""
    done, data = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    assert done
    path.write_bytes(data.tobytes())


def write_ply(path: Path, mesh: Mesh) -> None:
    """Binary little-endian PLY."""
    faces = np.empty(len(mesh.t_pos_idx), dtype=[("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, mesh.t_pos_idx.numpy()
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(mesh.v_pos)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode() + mesh.v_pos.numpy().astype("<f4").tobytes() + faces.tobytes())


def _zip_folder(folder: Path, archive: Path) -> None:
    """Store the folder's files in sorted order with fixed times, so that the same scan gives the same bytes."""
    with zipfile.ZipFile(archive, "w") as file:
        for path in sorted(p for p in folder.rglob("*") if p.is_file()):
            entry = zipfile.ZipInfo(path.relative_to(folder).as_posix())
            packed = path.suffix in {".json", ".ply", ".obj", ".mtl"}
            entry.compress_type = zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED
            file.writestr(entry, path.read_bytes())
