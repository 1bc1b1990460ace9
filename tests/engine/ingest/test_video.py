"""Pictures of videos: the right one, each decoded once, and broken files told apart."""

from __future__ import annotations

import contextlib
import io
import zipfile
from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from advtex_engine.core.config import TextureConfig
from advtex_engine.core.errors import Problem, ScanError
from advtex_engine.core.monitor import Monitor
from advtex_engine.ingest.read import ingest
from advtex_engine.ingest.video import VideoReader
from advtex_scan import ScanArchive, VideoFrame, check_scan, open_scan
from advtex_scan.video import read_video_header

WIDTH, HEIGHT, COUNT, FOCAL = 96, 64, 12, 90.0


class Listener(Monitor):
    def __init__(self) -> None:
        self.warnings: list[Problem] = []

    def warning(self, problem: Problem) -> None:
        self.warnings.append(problem)


def level(index: int) -> int:
    """The red of a picture, by which it is known."""
    return 20 * index + 10


def encoded(codec: str, count: int = COUNT, hidden: int = 0) -> bytes:
    """A video whose first `hidden` pictures players leave out, for they come before its start."""
    file = io.BytesIO()
    with av.open(file, "w", format="mp4", options={"avoid_negative_ts": "disabled"}) as container:
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        if codec == "libx265":
            stream.options = {"x265-params": "log-level=none:pools=none:frame-threads=1"}
        packets = []
        for index in range(count):
            picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
            picture[..., 0] = level(index)
            packets += stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24"))
        for packet in packets + stream.encode():
            earlier = round(hidden / 30 / packet.time_base)
            packet.pts, packet.dts = packet.pts - earlier, packet.dts - earlier
            container.mux(packet)
    return file.getvalue()


@pytest.fixture(scope="module")
def mpeg4() -> bytes:
    return encoded("mpeg4")


@contextlib.contextmanager
def archive_of(folder: Path, data: bytes, method: int | None = None) -> Iterator[ScanArchive]:
    (folder / "v").mkdir(exist_ok=True)
    (folder / "v" / "rgb.mp4").write_bytes(data)
    path = folder / "v"
    if method is not None:
        path = folder / "v.zip"
        with zipfile.ZipFile(path, "w", method) as bundle:
            bundle.writestr("rgb.mp4", data)
    with open_scan(path) as archive:
        yield archive


def shown(reader: VideoReader, index: int) -> int:
    picture = reader.read(VideoFrame("rgb.mp4", index))
    assert picture.shape == (HEIGHT, WIDTH, 3)
    assert picture.dtype == np.uint8
    return round((picture[..., 0].mean() - 10) / 20)


@pytest.mark.parametrize("codec", ["mpeg4", "libx264", "libx265"])
@pytest.mark.parametrize("method", [None, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_pictures_by_their_number(tmp_path: Path, codec: str, method: int | None) -> None:
    """Phones write HEVC, whose pictures are stored in another order than they are shown in."""
    with archive_of(tmp_path, encoded(codec), method) as archive:
        header = read_video_header(archive, "rgb.mp4")
        assert (header.width, header.height, header.frames) == (WIDTH, HEIGHT, COUNT)
        assert header.codec == {"mpeg4": "mp4v", "libx264": "avc1", "libx265": "hev1"}[codec]
        reader = VideoReader(archive, "rgb.mp4")
        assert [shown(reader, index) for index in range(COUNT)] == list(range(COUNT))


def test_pictures_can_be_left_out_and_gone_back_to(tmp_path: Path, mpeg4: bytes) -> None:
    with archive_of(tmp_path, mpeg4) as archive:
        reader = VideoReader(archive, "rgb.mp4")
        assert [shown(reader, index) for index in (2, 3, 9, 0, 0, 11)] == [2, 3, 9, 0, 0, 11]


def test_pictures_that_players_leave_out_are_counted(tmp_path: Path) -> None:
    data = encoded("mpeg4", hidden=3)
    with av.open(io.BytesIO(data)) as container:
        assert sum(1 for _ in container.decode(video=0)) == COUNT - 3
    with archive_of(tmp_path, data) as archive:
        reader = VideoReader(archive, "rgb.mp4")
        assert [shown(reader, index) for index in range(COUNT)] == list(range(COUNT))


def test_in_order_the_video_is_opened_once(tmp_path: Path, mpeg4: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[object] = []
    really = av.open
    monkeypatch.setattr(av, "open", lambda *args, **kwargs: (opened.append(args), really(*args, **kwargs))[1])
    with archive_of(tmp_path, mpeg4) as archive:
        reader = VideoReader(archive, "rgb.mp4")
        assert [shown(reader, index) for index in (0, 1, 5, 11)] == [0, 1, 5, 11]
    assert len(opened) == 1


@pytest.mark.parametrize("share", [0, 0.5, 0.95])
def test_a_video_that_is_cut_off_is_named(tmp_path: Path, mpeg4: bytes, share: float) -> None:
    with (
        archive_of(tmp_path, mpeg4[: int(share * len(mpeg4))]) as archive,
        pytest.raises(ScanError, match=r"rgb\.mp4 \(frame 0\)"),
    ):
        VideoReader(archive, "rgb.mp4").read(VideoFrame("rgb.mp4", 0))


def test_a_picture_beyond_the_last_is_named(tmp_path: Path, mpeg4: bytes) -> None:
    with archive_of(tmp_path, mpeg4) as archive, pytest.raises(ScanError, match=r"frame 12.*beyond the 12 pictures"):
        VideoReader(archive, "rgb.mp4").read(VideoFrame("rgb.mp4", COUNT))


def test_sound_alone_is_no_video(tmp_path: Path) -> None:
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("aac", rate=44100)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 4096), np.float32), format="fltp", layout="mono")
        sound.sample_rate = 44100
        container.mux(stream.encode(sound))
        container.mux(stream.encode())
    with archive_of(tmp_path, file.getvalue()) as archive, pytest.raises(ScanError, match="holds no pictures"):
        VideoReader(archive, "rgb.mp4").read(VideoFrame("rgb.mp4", 0))


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
@given(st.lists(st.tuples(st.integers(0, 1 << 20), st.integers(0, 255)), max_size=8), st.integers(0, 1 << 12))
@example(edits=[(36, 1)], cut=0)  # the pictures' box is said to end far beyond the file
def test_a_damaged_video_gives_pictures_or_our_error(tmp_path: Path, mpeg4: bytes, edits, cut: int) -> None:
    data = bytearray(mpeg4)
    for position, value in edits:
        data[position % len(data)] = value
    with archive_of(tmp_path, bytes(data[: len(data) - cut % len(data)])) as archive:
        reader = VideoReader(archive, "rgb.mp4")
        with contextlib.suppress(ScanError):
            for index in range(COUNT):
                reader.read(VideoFrame("rgb.mp4", index))


@pytest.fixture
def stray(tmp_path: Path, mpeg4: bytes) -> Path:
    """A capture of Stray Scanner: a wall at 2 m, of whose depth the left half is not trusted."""
    scan = tmp_path / "stray"
    for folder in ("depth", "confidence"):
        (scan / folder).mkdir(parents=True)
    (scan / "rgb.mp4").write_bytes(mpeg4)
    (scan / "camera_matrix.csv").write_text(f"{FOCAL},0,{WIDTH / 2}\n0,{FOCAL},{HEIGHT / 2}\n0,0,1\n")
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for index in range(COUNT):
        lines.append(f"{index / 30}, {index:06d}, {0.01 * index}, 0, 0, 0, 0, 0, 1")
        depth = np.full((HEIGHT // 2, WIDTH // 2), 2000, np.uint16)
        depth[0] = 6000  # beyond what the sensor measures
        trust = np.full(depth.shape, 2, np.uint8)
        trust[:, : WIDTH // 4] = 0
        cv2.imwrite(str(scan / "depth" / f"{index:06d}.png"), depth)
        cv2.imwrite(str(scan / "confidence" / f"{index:06d}.png"), trust)
    (scan / "odometry.csv").write_text("\n".join(lines))
    corners = "\n".join(f"v {x} {y} 2" for x, y in ((-4, -4), (4, -4), (4, 4), (-4, 4)))
    (scan / "mesh.obj").write_text(corners + "\nf 1 2 3 4\n")
    return scan


def test_a_video_becomes_views(stray: Path) -> None:
    assert check_scan(stray).ok
    listener = Listener()
    scene = ingest(stray, TextureConfig(), listener)
    assert [problem.code for problem in listener.warnings] == []
    assert [round((float(view.color[..., 0].float().mean()) - 10) / 20) for view in scene.views] == list(range(COUNT))
    for index, view in enumerate(scene.views):
        assert view.camera.K.tolist() == [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
        assert view.camera.world_to_camera[0, 3].item() == pytest.approx(-0.01 * index)
        assert view.depth is not None
        assert (view.depth[:, : WIDTH // 2 - 2] == 0).all(), "not trusted by the device"
        assert (view.depth[:2] == 0).all(), "beyond five metres"
        assert (view.depth[4:, WIDTH // 2 + 2 :] == 2).all()


def test_a_video_that_is_shorter_than_it_says_is_named(stray: Path) -> None:
    data = (stray / "rgb.mp4").read_bytes()
    few = encoded("mpeg4", count=4)
    (stray / "rgb.mp4").write_bytes(few)
    assert not check_scan(stray).ok, "twelve poses, four pictures"
    start = data.index(b"mdat") + 4
    (stray / "rgb.mp4").write_bytes(
        data[:start] + bytes(data.index(b"moov") - 4 - start) + data[data.index(b"moov") - 4 :]
    )
    assert check_scan(stray).ok, "all that can be told without decoding"
    with pytest.raises(ScanError, match=r"rgb\.mp4"):
        ingest(stray, TextureConfig(), Listener())
