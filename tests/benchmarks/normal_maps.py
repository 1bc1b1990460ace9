"""Whether the normal map of a decimated mesh would show shape or carve noise: figures and pictures of scans' meshes.

    python tests/benchmarks/normal_maps.py scan/mesh.ply[:FACES] ... [--pictures FOLDER]

A line per mesh: what `find_detail` measures at a budget of FACES (80,000), and its ratio of change to noise, which
`LEAST_RATIO` is compared with. Pictures show the mesh from outside, cut in half so that rooms are seen too, in a
grazing light: decimated, with the map, and undecimated.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from advtex_engine.atlas.build import new_atlas
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Camera, Mesh, face_areas
from advtex_engine.mesh.clean import clean, decimate
from advtex_engine.mesh.detail import Detail, find_detail
from advtex_engine.mesh.models import load_reference
from advtex_engine.mesh.normals import vertex_normals
from advtex_engine.mesh.tangents import TangentFrames
from advtex_engine.mesh.trim import drop_floaters
from advtex_engine.render.rasterize import rasterize
from advtex_engine.render.texture import sample_image
from advtex_engine.results.normal_map import bake_normals, decode_normals
from advtex_options.options import FACE_BUDGET

SIDE, PIXELS = 2048, 640
LIGHT = F.normalize(torch.tensor([-0.9, -0.3, -0.25]), dim=0)  # in camera axes: from the left, along the surface


def half_seen(mesh: Mesh) -> Camera:
    """Looks down the shortest side of the mesh; what is nearer than its middle lies before the near plane."""
    low, high = mesh.v_pos.amin(0).double(), mesh.v_pos.amax(0).double()
    order = torch.argsort(high - low, descending=True)
    axes = torch.eye(3, dtype=torch.float64)[order]
    axes[1] = torch.linalg.cross(axes[2], axes[0])
    size = float((high - low).max())
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = axes
    pose[:3, 3] = -axes @ ((low + high) / 2) + torch.tensor([0, 0, size])
    K = torch.tensor([[PIXELS, 0, PIXELS / 2], [0, PIXELS, PIXELS / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, pose, PIXELS, PIXELS)


def picture(fine: Mesh, decimated: Mesh) -> np.ndarray:
    wanted = face_areas(decimated)
    atlas = new_atlas(decimated, (wanted / wanted.sum() * 0.7 * SIDE**2).numpy(), SIDE, Monitor())
    started = time.process_time()
    error = find_detail(fine, decimated)[1]["error_mm"] / 1000
    image = bake_normals(Detail(fine, decimated.v_pos, error), atlas)
    print(f"  baked {image.shape[1]} x {image.shape[0]} in {time.process_time() - started:.1f} s of CPU")
    camera = half_seen(fine)
    near = float(camera.world_to_camera[2, 3])
    shown = list[torch.Tensor]()
    for mesh, normal_map in ((atlas.mesh, None), (atlas.mesh, image), (fine, None)):
        fragments = rasterize(mesh, camera, near=near)
        hit = fragments.face_index.flatten() >= 0
        face, weights = fragments.face_index.flatten()[hit].long(), fragments.barycentric.view(-1, 3)[hit]
        normal = F.normalize((vertex_normals(mesh)[mesh.t_pos_idx[face]] * weights[..., None]).sum(1), dim=1)
        if normal_map is not None:
            assert mesh.v_uv is not None and mesh.t_uv_idx is not None
            uv = (mesh.v_uv[mesh.t_uv_idx[face]] * weights[..., None]).sum(1)
            own = decode_normals(sample_image(normal_map, uv * uv.new_tensor(normal_map.shape[1::-1])))
            normal = (own[:, None] @ TangentFrames.of(mesh).at(face, weights))[:, 0]
        light = torch.zeros(PIXELS * PIXELS)
        light[hit] = 0.05 + 0.95 * (normal @ (camera.world_to_camera[:3, :3].float().T @ LIGHT)).abs()
        shown.append(light.view(PIXELS, PIXELS))
    pixels: np.ndarray = (255 * torch.cat(shown, 1).clamp(0, 1).numpy() ** (1 / 2.2)).astype(np.uint8)
    return pixels


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="+", metavar="MESH[:FACES]")
    parser.add_argument("--pictures", type=Path)
    given = parser.parse_args()
    for number, mesh in enumerate(given.meshes):
        path, _, faces = mesh.partition(":")
        loaded = load_reference(Path(path))
        fine, _ = drop_floaters(clean(Mesh(loaded.v_pos, loaded.t_pos_idx)))
        decimated = decimate(fine, int(faces or FACE_BUDGET), Monitor())
        started = time.process_time()
        _, report = find_detail(fine, decimated)
        seconds = time.process_time() - started
        ratio = report.get("change_degrees", 0) / max(report.get("noise_degrees", 1), 0.001)
        print(f"{mesh}: {report}, ratio {ratio:.2f}, {seconds:.1f} s of CPU", flush=True)
        if given.pictures and decimated is not fine:
            given.pictures.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(given.pictures / f"{number}.png"), picture(fine, decimated))


if __name__ == "__main__":
    main()
