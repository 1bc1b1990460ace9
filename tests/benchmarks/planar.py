"""The paper's 2D case (section 4.1): how near the patches of the optimized texture come to those of the truth.

    python tests/benchmarks/planar.py [--steps 2000] [--picture photo.png]

Prints the sliced Wasserstein distance of 7x7 patches to the truth, divided by that of the L1 optimum (per-pixel
median), with auxiliary views and, as the negative control, without.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from advtex_engine.config import PRESETS
from advtex_engine.discriminator import PatchDiscriminator
from advtex_engine.metrics import sliced_wasserstein
from advtex_engine.optimize import AdversarialOptimizer
from advtex_engine.planar import planar_maps, planar_pairs, shifted_views
from advtex_engine.synthetic_print import tin_side

SIZE, SHIFT, VIEWS = 128, 8, 60
PADDED = SIZE + 2 * SHIFT


def drawn_picture() -> Tensor:
    """A piece of print drawn by code, [PADDED,PADDED,3] uint8: lettering, ornament and grain."""
    rng = np.random.default_rng(0)
    tin = tin_side(300, 140, 1.1, rng)  # millimetres, pixels per millimetre
    return torch.from_numpy(tin[:PADDED, :PADDED].copy())


def cut(path: Path) -> Tensor:
    """The middle of a photograph at half its size."""
    image = cv2.imread(str(path))
    if image is None:
        raise SystemExit(f"{path} is no picture that can be read")
    half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)[..., ::-1]
    top, left = (half.shape[0] - PADDED) // 2, (half.shape[1] - PADDED) // 2
    return torch.from_numpy(half[top : top + PADDED, left : left + PADDED].copy())


def optimize(picture: Tensor, steps: int, *, auxiliary: bool, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """-> truth, L1 optimum and optimized texture, each [SIZE,SIZE,3] in [0,1]."""
    color = shifted_views(picture, SIZE, SHIFT, VIEWS, seed)
    maps = planar_maps(color, SIZE, SIZE)
    start = color.float().mean(0) / 255
    optimizer = AdversarialOptimizer(
        maps,
        planar_pairs(VIEWS, torch.device("cpu"), auxiliary=auxiliary),
        start[maps.slot_map >= 0],
        PRESETS["full"],
        kind="scene",
        steps=steps,
        generator=torch.Generator().manual_seed(seed),
        discriminator=PatchDiscriminator(torch.Generator().manual_seed(seed)),
    )
    for _ in range(steps):
        optimizer.step()
    start[maps.slot_map >= 0] = optimizer.values.detach()
    truth = picture[SHIFT:-SHIFT, SHIFT:-SHIFT].float() / 255
    return truth, color.float().median(0).values / 255, start.clamp(0, 1)


def ratio(picture: Tensor, steps: int, *, auxiliary: bool, save: Path | None = None) -> float:
    """Distance of the texture's patches to the truth's over that of the L1 optimum's."""
    truth, l1_optimum, texture = optimize(picture, steps, auxiliary=auxiliary)
    if save is not None:
        row = torch.cat((truth, l1_optimum, texture), 1).mul(255).round().byte().numpy()
        cv2.imwrite(str(save), row.repeat(3, 0).repeat(3, 1)[..., ::-1])
    return float(sliced_wasserstein(texture, truth)) / float(sliced_wasserstein(l1_optimum, truth))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--save", type=Path, help="PNG: truth, L1 optimum, texture with auxiliary views")
    arguments = parser.parse_args()
    picture = cut(arguments.picture) if arguments.picture else drawn_picture()
    for auxiliary in (True, False):
        save = arguments.save if auxiliary else None
        name = "with" if auxiliary else "without"
        print(
            f"{name} auxiliary views: {ratio(picture, arguments.steps, auxiliary=auxiliary, save=save):.3f}", flush=True
        )


if __name__ == "__main__":
    main()
