"""Charts of a mesh begun before they are needed, and kept for the next job that brings the same mesh.

Charts depend on the mesh alone, so that a child makes them while views are chosen and cameras refined. They are kept in
the user's cache folder, one file per mesh, named by a hash of all that decides them. Files are whole or absent, one
that cannot be read is as good as absent, and the least recently used go first; so any number of runs may share the
folder.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import io
import json
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt

from advtex_engine.atlas.charting import (
    BLOCK_FACES,
    CHART_COST,
    LARGE_MESH,
    PADDING,
    PART_FACES,
    Charts,
    Integers,
    make_charts,
)
from advtex_engine.core.errors import Stopped
from advtex_engine.core.monitor import Monitor
from advtex_engine.runtime.children import STOP_SECONDS
from advtex_engine.runtime.files import write_atomically

Position = npt.NDArray[np.float32]

LEAST_FACES = 20_000  # fewer are charted in about a second, which neither a child nor a file is worth
MAX_BYTES = 256 << 20  # of all files: 56 meshes of 100,000 faces
FORMAT = 1  # of a file: the digest of what follows, and arrays as NumPy packs them
DIGEST = 32  # bytes


def charts_folder() -> Path:
    """Where charts are kept: beside the weights that are downloaded."""
    import platformdirs

    return platformdirs.user_cache_path("advtex") / "charts"


class ChartMaker:
    """Makes a run's charts; a context manager that leaves no child behind.

    folder: of the cache; None keeps nothing. What goes wrong with the folder costs time and nothing else.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._begun: _Begun | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._drop()

    def begin(self, position: Position, faces: Integers) -> None:
        """Begins with the charts of a large mesh in a child, in place of those that were begun for another one."""
        if len(faces) < LEAST_FACES:
            return
        key = chart_key(position, faces)
        if (self._begun is not None and self._begun.key == key) or self._load(key) is not None:
            return
        self._drop()
        self._begun = _Begun(key, lambda monitor: make_charts(position, faces, monitor, apart=True))

    def make(self, position: Position, faces: Integers, monitor: Monitor) -> Charts:
        """What `make_charts` gives: as begun, as kept, or made now. Raises as it does."""
        if len(faces) < LEAST_FACES:
            return make_charts(position, faces, monitor)
        key = chart_key(position, faces)
        if self._begun is not None and self._begun.key == key:
            charts = self._begun.result(monitor)
        else:
            kept = self._load(key)
            if kept is not None:
                monitor.note("the mesh's charts are those of an earlier job")
                return kept
            charts = make_charts(position, faces, monitor)
        self._save(key, charts)
        return charts

    def _drop(self) -> None:
        if self._begun is not None:
            self._begun.cancel()
            self._begun = None

    def _load(self, key: str) -> Charts | None:
        if self._folder is None:
            return None
        path = self._folder / key
        try:
            digest, packed = (data := path.read_bytes())[:DIGEST], data[DIGEST:]
        except OSError:
            return None
        if hashlib.sha256(packed).digest() != digest:
            return None
        with np.load(io.BytesIO(packed), allow_pickle=False) as arrays:
            charts = Charts(**arrays)
        with suppress(OSError):
            path.touch()  # used just now
        return charts

    def _save(self, key: str, charts: Charts) -> None:
        if self._folder is None:
            return
        arrays = io.BytesIO()
        np.savez(arrays, allow_pickle=False, **vars(charts))
        packed = arrays.getvalue()
        with suppress(OSError):
            self._folder.mkdir(parents=True, exist_ok=True)
            write_atomically(self._folder / key, hashlib.sha256(packed).digest() + packed)
            _shrink(self._folder)


class _Begun:
    """Charts in the making, on a thread of their own that waits for the child."""

    def __init__(self, key: str, work: Callable[[Monitor], Charts]) -> None:
        self.key = key
        self._monitor = _Canceled()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="advtex-charts")
        self._charts: Future[Charts] = self._pool.submit(work, self._monitor)

    def result(self, monitor: Monitor) -> Charts:
        """Raises Stopped when the monitor asks for it, and what the child's end raised."""
        while not wait([self._charts], STOP_SECONDS).done:
            if monitor.stop_requested():
                self.cancel()
                raise Stopped("stopped while charts were made; resume begins them again")
        return self._charts.result()

    def cancel(self) -> None:
        """Ends the child, if it has not ended."""
        self._monitor.canceled.set()
        self._pool.shutdown()


class _Canceled(Monitor):
    """A child's monitor: a run's own monitor is called on the run's thread only."""

    def __init__(self) -> None:
        self.canceled = threading.Event()

    def stop_requested(self) -> bool:
        return self.canceled.is_set()


def chart_key(position: Position, faces: Integers) -> str:
    """A hash of all that decides the charts of a mesh: [V,3] positions, [T,3] faces, options, xatlas's version."""
    decided = {
        "format": FORMAT,
        "xatlas": importlib.metadata.version("xatlas"),
        "options": [PADDING, CHART_COST, BLOCK_FACES, LARGE_MESH, PART_FACES],
        "shapes": [position.shape, faces.shape],
    }
    digest = hashlib.sha256(json.dumps(decided).encode())
    digest.update(np.ascontiguousarray(position, "<f4").tobytes())
    digest.update(np.ascontiguousarray(faces, "<i8").tobytes())
    return digest.hexdigest()


def _shrink(folder: Path) -> None:
    """Removes what was used longest ago until the rest is within the bound."""
    found = []
    for path in folder.iterdir():
        with suppress(OSError):  # another run removed it
            told = path.stat()
            found.append((told.st_mtime, told.st_size, path))
    room = MAX_BYTES
    for _, size, path in sorted(found, reverse=True):
        room -= size
        if room < 0:
            path.unlink(missing_ok=True)
