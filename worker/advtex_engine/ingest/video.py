"""Pictures of the videos in a scan, decoded one after the other."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import TYPE_CHECKING

import av
import numpy as np
from av.error import FFmpegError

from advtex_engine.core.errors import ScanError
from advtex_engine.ingest.decode import Color, broken
from advtex_scan.archive import ScanArchive
from advtex_scan.manifest import VideoFrame

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

BUFFER = 1 << 20


class VideoReader:
    """The pictures of one video. Asked for in rising order, each is decoded once."""

    def __init__(self, archive: ScanArchive, path: str) -> None:
        self._archive = archive
        self._path = path
        self._pictures: Iterator[av.VideoFrame] = iter(())
        self._next = 0
        self._started = False

    def read(self, ref: VideoFrame) -> Color:
        """A picture as [height,width,3] uint8 RGB, as the sensor has it. Raises ScanError if it cannot be decoded."""
        if not self._started or ref.index < self._next:
            self._pictures, self._next, self._started = self._decoded(), 0, True
        try:
            for picture in self._pictures:
                self._next += 1
                if self._next == ref.index + 1:
                    return np.asarray(picture.to_ndarray(format="rgb24"), np.uint8)
        except FFmpegError as error:
            raise ScanError(broken(ref, f"cannot be decoded ({error.strerror})")) from error
        raise ScanError(broken(ref, f"is beyond the {self._next} pictures that could be decoded"))

    def _decoded(self) -> Iterator[av.VideoFrame]:
        source = io.BufferedReader(_ArchiveFile(self._archive, self._path), BUFFER)
        # Poses and depth go by the recorded pictures, also by those that the file asks players not to show.
        options = {"ignore_editlist": "1"}
        with av.open(source, "r", metadata_errors="ignore", options=options) as container:
            if not container.streams.video:
                raise ScanError(broken(VideoFrame(self._path, 0), "holds no pictures"))
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            yield from container.decode(stream)


class _ArchiveFile(io.RawIOBase):
    """A file of an archive that can be read at any position."""

    def __init__(self, archive: ScanArchive, path: str) -> None:
        self._archive, self._path = archive, path
        self._size = archive.size(path)
        self._position = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        self._position = max(0, offset + {0: 0, 1: self._position, 2: self._size}[whence])
        return self._position

    def tell(self) -> int:
        return self._position

    def readinto(self, buffer: WriteableBuffer, /) -> int:
        view = memoryview(buffer).cast("B")
        length = min(len(view), self._size - self._position)
        if length <= 0:  # a damaged file sends its reader beyond its end
            return 0
        view[:length] = self._archive.read_range(self._path, self._position, length)
        self._position += length
        return length
