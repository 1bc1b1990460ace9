"""A photograph that images are compared with, and what metrics find of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from torch import Tensor

Part = TypeVar("Part")


@dataclass(frozen=True, eq=False)
class Photograph:
    """color: [H,W,3] float sRGB in [0,1]. mask: [H,W] bool, the pixels that count.

    Several images are compared with one at the cost of their own parts: those of the photograph are found once, and
    kept as long as it is. At 640x480 all metrics together keep 40 MB. For one thread.
    """

    color: Tensor
    mask: Tensor
    _found: dict[Callable[..., Any], Any] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        assert self.color.shape == (*self.mask.shape, 3)
        assert self.mask.dtype == torch.bool

    def once(self, part: Callable[[Tensor, Tensor], Part]) -> Part:
        """part(color, mask), which nobody may change."""
        if part not in self._found:
            self._found[part] = part(self.color, self.mask)
        found: Part = self._found[part]
        return found
