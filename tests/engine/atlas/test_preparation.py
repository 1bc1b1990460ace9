"""A mesh that is made ready beside something else."""

from __future__ import annotations

import threading
import time

import pytest
import torch
import trimesh

from advtex_engine.atlas import preparation
from advtex_engine.atlas.chart_cache import ChartMaker
from advtex_engine.atlas.preparation import MeshPreparation
from advtex_engine.core.errors import Stopped
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Mesh


@pytest.mark.parametrize("moves", [False, True])
def test_the_end_of_a_run_ends_what_was_begun(monkeypatch: pytest.MonkeyPatch, moves: bool) -> None:
    begun, ended = threading.Event(), threading.Event()

    def endless(_mesh: Mesh, _budget: int, monitor: Monitor, *_: object) -> Mesh:
        """As a child that collapses a mesh of millions of faces: it is ended when its monitor says so."""
        begun.set()
        while not monitor.stop_requested():
            time.sleep(0.01)
        ended.set()
        raise Stopped("canceled")

    monkeypatch.setattr(preparation, "decimate", endless)
    ball = trimesh.creation.icosphere(subdivisions=2)
    mesh = Mesh(torch.tensor(ball.vertices, dtype=torch.float32), torch.tensor(ball.faces))

    def stopped_run() -> None:
        with ChartMaker(None) as charts, MeshPreparation(100, charts) as prepared:
            prepared.begin(mesh, moves=moves)
            prepared.look(())
            assert begun.wait(10)
            raise Stopped("stopped after another stage")

    with pytest.raises(Stopped, match="after another stage"):
        stopped_run()
    assert ended.is_set()
