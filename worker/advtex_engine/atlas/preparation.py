"""The mesh is made ready, and its charts are begun, while something else goes on: a scan's frames are decoded."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Self

from advtex_engine.atlas.build import begin_charts
from advtex_engine.atlas.chart_cache import ChartMaker
from advtex_engine.core.errors import Problem
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Mesh
from advtex_engine.mesh.clean import clean, decimate


class MeshPreparation:
    """Cleans and decimates a mesh on a thread of its own; a context manager that leaves no thread behind.

    The charts are begun there as well where the mesh will stay as it is.
    """

    def __init__(self, face_budget: int, charts: ChartMaker) -> None:
        self._face_budget, self._charts = face_budget, charts
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="advtex-mesh")
        self._prepared: Future[tuple[Mesh, list[Problem]]] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._pool.shutdown()

    def begin(self, mesh: Mesh, *, moves: bool = False) -> None:
        """Begins with a mesh. moves: it will be moved, so that charts of it would be of no use."""
        self._prepared = self._pool.submit(self._prepare, mesh, moves)

    def result(self, monitor: Monitor) -> Mesh:
        """The mesh that was begun with, once it is ready; raises what `clean` does, and tells the monitor the rest."""
        assert self._prepared is not None
        mesh, problems = self._prepared.result()
        for problem in problems:
            monitor.warning(problem)
        return mesh

    def _prepare(self, mesh: Mesh, moves: bool) -> tuple[Mesh, list[Problem]]:
        said = _Said()
        prepared = decimate(clean(mesh), self._face_budget, said)
        if not moves:
            begin_charts(prepared, self._charts)
        return prepared, said.problems


class _Said(Monitor):
    """Keeps warnings: a run's own monitor is called on the run's thread only."""

    def __init__(self) -> None:
        self.problems = list[Problem]()

    def warning(self, problem: Problem) -> None:
        self.problems.append(problem)
