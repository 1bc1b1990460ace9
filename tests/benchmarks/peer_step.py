"""Milliseconds per step of the ECCV 2022 PyTorch loop and of ours, on the same views and device in one run.

    python tests/benchmarks/peer_step.py CHECKOUT [--size 640x480] [--views 100] [--steps 200] [--device cuda]

CHECKOUT: of the code released with Zhao, Zhao, Schwing, "Initialization and Alignment for Adversarial Texture
Optimization" (ECCV 2022); it stays where it is, outside of this repository. What its loop needs beside this project's
own requirements has to be installed where this runs: joblib, Pillow, tqdm. It imports torchvision and uses nothing of
it, so an empty module stands in where there is none.

The views of the bench's own scene are written as the peer reads them, and its `train` runs unchanged, loader included,
with the options of its run.sh; only its progress bar is replaced, by one that waits for the device and looks at the
clock. Its texture starts from the projected mean at the atlas's size. Ours takes the same views and texture through
the step that a run takes, once with the published method's numbers and once with those of the preset full. The peer
comes first, alone, in a process of its own; then ours.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from advtex_engine.adversarial.cuda_graph import Stepper
from advtex_engine.bench.run import full_optimizer, step_times
from advtex_engine.bench.scene import made_scene
from advtex_engine.core.config import PRESETS
from advtex_engine.core.scene import Atlas, Mesh, Scene
from advtex_engine.methods.mean import mean_texture
from advtex_engine.render.pairs import Pairs, related_pairs
from advtex_engine.render.texture import decode_uv
from advtex_engine.render.view_maps import ViewMaps, build_view_maps
from advtex_engine.runtime.devices import choose_device

PACKAGE = "advtex_init_align"
NEEDED = tuple(
    f"{PACKAGE}/tex_smooth/{name}.py" for name in ("optim_patch_torch", "dataset_torch", "model_torch", "utils")
)
RUNNER = Path(__file__).with_name("peer_runner.py")
OURS = ("paper", "full")


class PeerError(Exception):
    """The peer cannot be run; the message says what is missing."""


def check(checkout: Path) -> None:
    """Raises PeerError for a folder that does not hold the peer's code."""
    missing = [name for name in NEEDED if not (checkout / name).is_file()]
    if missing:
        raise PeerError(
            f"{checkout} is no checkout of the ECCV 2022 code: it lacks {', '.join(missing)}. Give the folder that "
            f"holds {PACKAGE}/ and README.md"
        )


def write_views(folder: Path, scene: Scene, atlas: Atlas, maps: ViewMaps, pairs: Pairs) -> None:
    """The views as the peer's dataset reads them, and the texture it starts from.

    Its pixel centers are whole numbers, its v counts from the texture's lower edge, and the centers of the outermost
    texels are at 0 and 1. Its files of depth and uv are compressed, and a view is among its own pairs, as its converter
    has them.
    """
    (folder / "raw_colors").mkdir(parents=True)
    (folder / "shape").mkdir()
    shape = (maps.height, maps.width)
    size = np.array((atlas.width, atlas.height), np.float32)
    for index, view in enumerate(scene.views):
        color, depth = maps.color[index].view(*shape, 3), maps.depth[index].view(shape)
        uv = decode_uv(maps.uv[index]).view(*shape, 2).cpu().numpy()
        name = f"{index:05d}"
        cv2.imwrite(str(folder / "raw_colors" / f"{name}_raw_color.png"), color.cpu().numpy()[..., ::-1])
        uv = ((uv * size - 0.5) / (size - 1)).clip(0, 1)
        np.savez_compressed(folder / f"{name}_uv.npz", np.stack((uv[..., 0], 1 - uv[..., 1]), 2))
        np.savez_compressed(folder / f"{name}_depth.npz", depth.float().cpu().numpy())
        cv2.imwrite(str(folder / f"{name}_mask.png"), (depth > 0).to(torch.uint8).mul(255).cpu().numpy())
        intrinsic = np.eye(4)
        intrinsic[:3, :3] = view.camera.K.numpy()
        intrinsic[:2, 2] -= 0.5
        np.savetxt(folder / f"{name}_intrinsic.txt", intrinsic)
        np.savetxt(folder / f"{name}_pose.txt", view.camera.world_to_camera.numpy())
    rows = zip(pairs.auxiliary.tolist(), pairs.count.tolist(), strict=True)
    # The peer's converter lists the view itself, which comes first, and its dataset adds it once more.
    (folder / "pairs.json").write_text(json.dumps([row[:count] for row, count in rows]))
    start = (mean_texture(maps).clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    assert start.shape[:2] == (atlas.height, atlas.width)
    cv2.imwrite(str(folder / "shape" / "mtl0.png"), start[..., ::-1])


def time_peer(checkout: Path, folder: Path, device: torch.device, warmup: int, steps: int) -> list[float]:
    """Seconds of each of `steps` steps of the peer, after the warm-up. Raises PeerError with what it printed."""
    request = {"folder": str(folder), "warmup": warmup, "steps": steps, "threads": torch.get_num_threads()}
    visible = str(device.index or 0) if device.type == "cuda" else ""
    outer = [path for path in (os.environ.get("PYTHONPATH"),) if path]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join((str(checkout), *outer)),
        "CUDA_VISIBLE_DEVICES": os.environ.get("CUDA_VISIBLE_DEVICES", visible) if visible else "",
    }
    command = [sys.executable, str(RUNNER), json.dumps(request)]
    done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=False)
    result = folder / "seconds.json"
    if done.returncode != 0 or not result.is_file():
        tail = "\n".join((done.stdout + done.stderr).strip().splitlines()[-12:])
        raise PeerError(f"the peer ended with status {done.returncode}:\n{tail}")
    seconds: list[float] = json.loads(result.read_text())
    return seconds


def compare(arguments: argparse.Namespace) -> dict[str, Any]:
    """Medians in milliseconds, and what they were measured on."""
    check(arguments.checkout)
    device = choose_device(arguments.device)
    width, height = (int(side) for side in arguments.size.split("x"))
    scene, atlas = made_scene(arguments.faces, arguments.views, width, height)
    mesh = atlas.mesh
    assert mesh.v_uv is not None and mesh.t_uv_idx is not None
    on_device = Mesh(*(part.to(device) for part in (mesh.v_pos, mesh.t_pos_idx, mesh.v_uv, mesh.t_uv_idx)))
    atlas = Atlas(on_device, atlas.width, atlas.height, atlas.source, atlas.charts)
    maps = build_view_maps(atlas, scene.views, scene.kind)
    paper = PRESETS["paper"]
    pairs = related_pairs(maps, scene.kind, paper.max_pair_angle, paper.min_pair_overlap)
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "views"
        write_views(folder, scene, atlas, maps, pairs)
        peer = time_peer(arguments.checkout.resolve(), folder, device, arguments.warmup, arguments.steps)
    result: dict[str, Any] = {
        "device": "cpu" if device.type == "cpu" else torch.cuda.get_device_name(device),
        "threads": torch.get_num_threads(),
        "load": round(load, 2),
        "size": arguments.size,
        "views": len(scene.views),
        "texture": atlas.width,
        "peer_ms": round(statistics.median(peer) * 1e3, 2),
        "peer_mean_ms": round(statistics.mean(peer) * 1e3, 2),  # with the start of its loader once per round of views
    }
    for preset in OURS:
        median = statistics.median(step_times(Stepper(full_optimizer(maps, pairs, PRESETS[preset]))))
        result[f"ours_{preset}_ms"] = round(median * 1e3, 3)
        result[f"ratio_{preset}"] = round(statistics.median(peer) / median, 2)
    return result


def main(line: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", type=Path, help="folder with the peer's code")
    parser.add_argument("--size", default="640x480", help="WIDTHxHEIGHT of the views")
    parser.add_argument("--views", type=int, default=100)
    parser.add_argument("--faces", type=int, default=80_000)
    parser.add_argument("--warmup", type=int, default=20, help="steps of the peer that do not count")
    parser.add_argument("--steps", type=int, default=200, help="of the peer that are timed")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    arguments = parser.parse_args(line)
    try:
        result = compare(arguments)
    except PeerError as error:
        print(f"peer_step: {error}", file=sys.stderr)
        return 1
    if arguments.json:
        print(json.dumps(result))
    else:
        for key, value in result.items():
            print(f"{key:20} {value}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
