"""Views go to the device in order, few at a time, and nothing is used before it has arrived."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from typing import Any

import pytest
import torch

from advtex_engine.core.scene import Camera, View
from advtex_engine.render import prefetch as uploads
from advtex_engine.render.prefetch import AHEAD, uploaded


def view(index: int) -> View:
    camera = Camera(torch.eye(3, dtype=torch.float64), torch.eye(4, dtype=torch.float64), 4, 3)
    return View(str(index), camera, torch.full((3, 4, 3), index, dtype=torch.uint8), torch.ones(3, 4))


def test_on_a_cpu_views_stay_where_they_are() -> None:
    given = [view(index) for index in range(3)]
    found = list(uploaded(given, torch.device("cpu")))
    assert [one.name for one in found] == ["0", "1", "2"]
    assert all(one.color is old.color and one.depth is old.depth for one, old in zip(found, given, strict=True))


def test_to_a_gpu_they_go_ahead_and_each_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    class Stream:
        """Of the device that computes and of the one for copies: what is recorded and waited for."""

        def record_event(self) -> str:
            return names.pop(0)

        def wait_event(self, event: str) -> None:
            waited.append(event)

    def moved(one: View, device: torch.device, with_color: bool) -> View:
        assert device.type == "cuda"
        assert with_color is False
        return one

    def views() -> Iterator[View]:
        for index in range(8):
            drawn.append(index)
            yield view(index)

    names, waited, drawn = [str(index) for index in range(8)], list[str](), list[int]()
    stream: Any = Stream()
    monkeypatch.setattr(uploads, "_moved", moved)
    monkeypatch.setattr(torch.cuda, "Stream", lambda _: stream)
    monkeypatch.setattr(torch.cuda, "stream", lambda _: nullcontext())
    monkeypatch.setattr(torch.cuda, "current_stream", lambda _: stream)
    for count, one in enumerate(uploaded(views(), torch.device("cuda:0"), with_color=False), 1):
        assert one.name == str(count - 1)
        assert len(waited) == count, "this view's copy and no other is waited for"
        assert len(drawn) <= count + AHEAD
    assert sorted(waited) == [str(index) for index in range(8)]
