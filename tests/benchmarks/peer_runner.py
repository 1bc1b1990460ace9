"""What runs in the peer's process: its own `train`, with a progress bar that looks at the clock (see peer_step.py)."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import pickle  # noqa: TID251 - the peer reads its pairs from a pickle; it is written here and read by no one else
import random
import sys
import time
from itertools import pairwise
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch

LOADER_WORKERS = 6  # the peer's default


class Clock:
    """In place of tqdm's bar: the peer calls `update` once at the beginning of each step."""

    def __init__(self, total: int) -> None:
        self.total = total
        self.times = list[float]()
        made.append(self)

    def update(self, _steps: int = 1) -> None:
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        self.times.append(time.perf_counter())


made = list[Clock]()


class Frequencies:
    """The peer takes elements of torch.fft.fftfreq, on the host, by indices on the device: only PyTorch < 1.13 did."""

    def __init__(self, values: torch.Tensor) -> None:
        self.values = values

    def __mul__(self, factor: int) -> Frequencies:
        return Frequencies(self.values * factor)

    def __getitem__(self, index: torch.Tensor) -> torch.Tensor:
        return self.values[index.to(self.values.device)]


def stand_in() -> None:
    """What lets the peer's files, written for PyTorch 1.9, run as they are."""
    if importlib.util.find_spec("torchvision") is None:
        sys.modules["torchvision"] = ModuleType("torchvision")  # imported and not used
    fftfreq = torch.fft.fftfreq
    torch.fft.fftfreq = lambda count: Frequencies(fftfreq(count))


def options(folder: Path) -> argparse.Namespace:
    """As the peer's run.sh and the defaults of its command line have them."""
    return argparse.Namespace(
        seed=123,
        num_workers=LOADER_WORKERS,
        input_dir=str(folder),
        output_dir=str(folder / "out"),
        lr_G=1e-3,
        lr_D=1e-4,
        beta1=0.5,
        data_chair=0,
        use_mislaign_offset=1,  # as the peer spells it
        from_scratch=0,
        scannet=0,
        z_diff_threshold=0.1,
        n_patches_h=1,
        n_patches_w=1,
    )


def main() -> None:
    request = json.loads(sys.argv[1])
    folder, warmup, steps = Path(request["folder"]), request["warmup"], request["steps"]
    torch.set_num_threads(request["threads"])
    pairs = json.loads((folder / "pairs.json").read_text())
    (folder / "pose_pair.pkl").write_bytes(pickle.dumps(pairs))
    joblib = importlib.import_module("joblib")
    joblib.dump(dict.fromkeys(range(len(pairs)), (0, 0)), folder / "offset_dict.p")
    (folder / "out" / "shape").mkdir(parents=True)
    stand_in()
    peer: Any = importlib.import_module("advtex_init_align.tex_smooth.optim_patch_torch")
    chosen = options(folder)
    # As the peer's command line does before it trains.
    random.seed(chosen.seed)
    np.random.seed(chosen.seed)
    torch.manual_seed(chosen.seed)
    torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = True, False
    peer.tqdm = SimpleNamespace(tqdm=Clock)
    peer.MAX_STEPS = warmup + steps + 1  # one more beginning, which ends the last step
    peer.train(chosen)
    (clock,) = made
    times = clock.times[warmup:]
    seconds = [after - before for before, after in pairwise(times)]
    assert len(seconds) == steps, f"{len(seconds)} steps were seen in place of {steps}"
    (folder / "seconds.json").write_text(json.dumps(seconds))


if __name__ == "__main__":
    main()
