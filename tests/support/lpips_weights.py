"""LPIPS with random weights: a distance of the right kind, without a download."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from advtex_engine.metrics.lpips import NETWORKS, FeatureStack, Lpips


def states() -> dict[str, dict[str, Tensor]]:
    """Random weights by the names under which they are published."""
    generator = torch.Generator().manual_seed(0)
    backbone, heads = dict[str, Tensor](), dict[str, Tensor]()
    for index, layer in enumerate(NETWORKS["alexnet"]):
        shape = (layer.outputs, layer.inputs, layer.kernel, layer.kernel)
        backbone[f"features.{layer.number}.weight"] = torch.randn(shape, generator=generator) * 0.05
        backbone[f"features.{layer.number}.bias"] = torch.zeros(layer.outputs)
        heads[f"lin{index}.model.1.weight"] = torch.rand((1, layer.outputs, 1, 1), generator=generator)
    return {"alexnet-owt-7be5be79.pth": backbone, "alex.pth": heads}


def write_weights(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, state in states().items():
        torch.save(state, folder / name)
    return folder


def random_lpips() -> Lpips:
    backbone, heads = states().values()
    return Lpips(FeatureStack("alexnet", backbone), list(heads.values()))
