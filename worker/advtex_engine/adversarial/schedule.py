"""What changes from step to step: lambda, the learning rates, pretraining and the texture's average.

Each is a plain function of the step's index. A step that is captured as a CUDA graph can call no such function: it
reads their values from a table on the device, at an index that it counts up itself. Table, row and index keep their
addresses for as long as the run lasts.
"""

from __future__ import annotations

import torch
from torch import Tensor

from advtex_engine.core.config import Preset

AVERAGE_EVERY = 10  # steps between two states that enter the texture's average
COLUMNS = ("l1_weight", "lr_texture", "lr_discriminator", "pretraining", "average_weight")


class Schedule:
    """The run's `steps` steps over all levels of a pyramid, the first preset.pretraining of them without the texture.

    index: of the next step, on the host. row: [len(COLUMNS)] float32 on the device, of the step that `read` was called
    for; its elements are also attributes by the names of COLUMNS, 0-dim views.
    """

    l1_weight: Tensor
    lr_texture: Tensor
    lr_discriminator: Tensor
    pretraining: Tensor
    average_weight: Tensor

    def __init__(self, preset: Preset, steps: int, device: torch.device) -> None:
        self.preset, self.steps = preset, steps
        rows = [self.row_at(index) for index in range(steps)]
        self._table = torch.tensor(rows, dtype=torch.float32, device=device)
        self._at = torch.zeros(1, dtype=torch.int64, device=device)
        self._index = 0
        self.row = self._table[0].clone()
        for column, name in enumerate(COLUMNS):
            setattr(self, name, self.row[column])

    @property
    def index(self) -> int:
        return self._index

    @index.setter
    def index(self, index: int) -> None:
        self._index = index
        self._at.fill_(index)

    def count(self, steps: int) -> None:
        """Tells the host that the device has been given these many steps to take."""
        self._index += steps

    def read(self) -> None:
        """Fills `row` for the step that the device is at, and moves the device's index on. Waits for nothing."""
        torch.index_select(self._table, 0, self._at, out=self.row.unsqueeze(0))
        self._at += 1

    def row_at(self, index: int) -> tuple[float, ...]:
        """The values of COLUMNS at a step."""
        share, preset = self.lr_share_at(index), self.preset
        return (
            self.l1_weight_at(index),
            preset.lr_texture * share * self.l1_decay_at(index) ** preset.lr_follows,
            preset.lr_discriminator * share,
            float(self.pretraining_at(index)),
            self.average_weight_at(index),
        )

    def l1_weight_at(self, index: int) -> float:
        """lambda: l1_weight times l1_decay for each passed period; the paper's 1,000 of 50,000 steps are one period."""
        return self.preset.l1_weight * self.l1_decay_at(index)

    def l1_decay_at(self, index: int) -> float:
        """lambda as a share of what it was at the start."""
        return self.preset.l1_decay ** int(index * self.preset.l1_decays / self.steps)

    def pretraining_at(self, index: int) -> bool:
        """Whether the texture still waits for the discriminator."""
        return index < self.preset.pretraining

    def lr_share_at(self, index: int) -> float:
        """The share of both learning rates: 1 while the discriminator learns alone, then straight to lr_end."""
        done = max(0.0, (index - self.preset.pretraining) / max(1, self.steps - self.preset.pretraining))
        return 1 - (1 - self.preset.lr_end) * done

    def average_weight_at(self, index: int) -> float:
        """The weight of the texture after this step in its average: over all so far, then over `averaging` steps."""
        taken, rest = divmod(index - self.preset.pretraining, AVERAGE_EVERY)
        if not self.preset.averaging or taken < 0 or rest:
            return 0.0
        return 1 / min(taken + 1, max(1, self.preset.averaging // AVERAGE_EVERY))
