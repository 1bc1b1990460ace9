"""The mesh is made ready, and its charts are begun, while something else goes on: a scan's frames are decoded."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from types import TracebackType
from typing import Any, Self

from advtex_engine.atlas.build import begin_charts
from advtex_engine.atlas.chart_cache import ChartMaker
from advtex_engine.core.errors import Problem
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import DepthFrame, Mesh
from advtex_engine.mesh.clean import clean, decimate
from advtex_engine.mesh.detail import Detail, find_detail
from advtex_engine.mesh.holes import close_holes
from advtex_engine.mesh.trim import crop, drop_floaters
from advtex_options.box import Box


@dataclass(frozen=True)
class Trimmed:
    """Faces that were left out of a mesh or added to it. made_up_faces: they close holes, and are its last ones."""

    faces_outside_box: int = 0
    floaters: int = 0
    floater_faces: int = 0
    closed_holes: int = 0
    made_up_faces: int = 0


@dataclass(frozen=True)
class _Prepared:
    mesh: Mesh
    trimmed: Trimmed
    problems: list[Problem]
    detail: Future[tuple[Detail | None, dict[str, Any]]]  # found while the mesh is used already


class MeshPreparation:
    """Cleans, trims and decimates a mesh on a thread of its own; a context manager that leaves no thread behind.

    box: all outside is left out. holes: those with a border no longer than this are closed, metres. The charts are
    begun there as well where the mesh will stay as it is. One that has to be decimated waits for `look`.
    """

    def __init__(
        self, face_budget: int, charts: ChartMaker, *, box: Box | None = None, holes: float | None = None
    ) -> None:
        self._face_budget, self._charts, self._box, self._holes = face_budget, charts, box, holes
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="advtex-mesh")
        self._up_axis = "+z"
        self._reduced: Future[tuple[Mesh, list[Problem]]] | None = None  # of a mesh that moves
        self._prepared: Future[_Prepared] | None = None
        self._frames = Future[Sequence[DepthFrame]]()
        self._canceled = threading.Event()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._canceled.set()
        self.look(())
        self._pool.shutdown()

    def begin(self, mesh: Mesh, *, up_axis: str = "+z", moves: bool = False) -> None:
        """Begins with a mesh. moves: `result` will move it, so that charts of it would be of no use, and then trims it:
        the box is one of the world that it is moved to."""
        self._up_axis = up_axis
        self._reduced = self._pool.submit(self._reduce, mesh) if moves else None
        self._prepared = None if moves else self._pool.submit(self._prepare, mesh, up_axis, False)

    def look(self, frames: Sequence[DepthFrame]) -> None:
        """Gives what the depth camera measured, for `decimate`; only the first time counts."""
        if not self._frames.done():
            self._frames.set_result(frames)

    def result(self, monitor: Monitor, move: Callable[[Mesh], Mesh] | None = None) -> tuple[Mesh, dict[str, Any]]:
        """The mesh that was begun with, once it is ready, and what was trimmed of it, for the report.

        move: of a mesh that moves. Without `look` before it, the mesh is decimated by itself. Raises what it, `clean`
        and `crop` do, and tells the monitor the rest.
        """
        self.look(())
        if self._prepared is None:
            assert self._reduced is not None
            reduced, said = self._reduced.result()
            for problem in said:
                monitor.warning(problem)
            moved = reduced if move is None else move(reduced)
            self._prepared = self._pool.submit(self._prepare, moved, self._up_axis, True)
        prepared = self._prepared.result()
        for problem in prepared.problems:
            monitor.warning(problem)
        return prepared.mesh, asdict(prepared.trimmed)

    def detail(self) -> tuple[Detail | None, dict[str, Any]]:
        """What decimation took of the mesh that `result` gives, and the report about it, as `find_detail` has them."""
        assert self._prepared is not None
        return self._prepared.result().detail.result()

    def _reduce(self, mesh: Mesh) -> tuple[Mesh, list[Problem]]:
        said = _Said(self._canceled)
        return decimate(clean(mesh), self._face_budget, said), said.problems

    def _prepare(self, mesh: Mesh, up_axis: str, moves: bool) -> _Prepared:
        said = _Said(self._canceled)
        cleaned = clean(mesh)
        cropped = cleaned if self._box is None else crop(cleaned, self._box, up_axis)
        kept, floaters = drop_floaters(cropped)
        lost = len(cropped.t_pos_idx) - len(kept.t_pos_idx)
        if floaters:
            said.warning(_floaters_dropped(floaters, lost))
        frames = self._frames.result() if len(kept.t_pos_idx) > self._face_budget else ()
        prepared = decimate(kept, self._face_budget, said, frames)
        closed, holes = (prepared, 0) if self._holes is None else close_holes(prepared, self._holes)
        if holes and prepared.v_uv is not None:
            said.warning(_uv_dropped(holes))
        if not moves:
            begin_charts(closed, self._charts)
        outside, added = (
            len(cleaned.t_pos_idx) - len(cropped.t_pos_idx),
            len(closed.t_pos_idx) - len(prepared.t_pos_idx),
        )
        detail = self._pool.submit(find_detail, kept, prepared)
        return _Prepared(closed, Trimmed(outside, floaters, lost, holes, added), said.problems, detail)


def _floaters_dropped(floaters: int, faces: int) -> Problem:
    return Problem(
        "floaters_dropped",
        "mesh",
        f"{floaters:,} small loose pieces of together {faces:,} faces are left out",
        "none needed; what is missing of the model has to be connected to the rest of the mesh",
    )


def _uv_dropped(holes: int) -> Problem:
    return Problem(
        "uv_dropped",
        "mesh",
        f"the mesh's texture coordinates are not kept: {holes:,} holes were closed by faces that have none",
        "leave the holes open, or accept the new atlas",
    )


class _Said(Monitor):
    """Keeps warnings: a run's own monitor is called on the run's thread only. Stops what nobody waits for any more."""

    def __init__(self, canceled: threading.Event) -> None:
        self.problems = list[Problem]()
        self._canceled = canceled

    def stop_requested(self) -> bool:
        return self._canceled.is_set()

    def warning(self, problem: Problem) -> None:
        self.problems.append(problem)
