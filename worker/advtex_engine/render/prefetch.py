"""Views on their way to a GPU while it and the host work on those before: uploads cost no time of their own."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import torch
from torch import Tensor

from advtex_engine.core.scene import View
from advtex_engine.runtime.threads import in_threads

AHEAD = 2  # copies at once: while one waits for the bus, the host reads the next


def uploaded(views: Iterable[View], device: torch.device, *, with_color: bool = True) -> Iterator[View]:
    """The views in order, their depth and mask on the device, and their color if it is wanted there.

    To a GPU they go by threads and a stream of their own. What yields `views` (decoding, shrinking) is asked for the
    next ones while those before are under way.
    """
    if device.type != "cuda":
        yield from (_moved(view, device, with_color) for view in views)
        return
    stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]

    def upload(view: View) -> tuple[View, torch.cuda.Event]:
        with torch.cuda.stream(stream):
            return _moved(view, device, with_color), stream.record_event()

    for view, event in in_threads(upload, views, AHEAD):
        current = torch.cuda.current_stream(device)
        current.wait_event(event)
        for part in (view.color, view.depth, view.mask):
            if (
                part is not None and part.is_cuda
            ):  # its memory is another stream's, which must not have it back too early
                part.record_stream(current)
        yield view


def _moved(view: View, device: torch.device, with_color: bool) -> View:
    def there(part: Tensor | None) -> Tensor | None:
        return None if part is None else part.to(device)

    color = view.color.to(device) if with_color else view.color
    return replace(view, color=color, depth=there(view.depth), mask=there(view.mask))
