"""Downloads: continued where they stopped, never half there, never outside of their folder."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from fake_server import FakeServer, breaks, cuts_off, refuses, view
from hypothesis import given
from hypothesis import strategies as st

from advtex_client import Client, ClientError, IntegrityError, NetworkError
from advtex_client._calls import only_results
from advtex_client.downloads import target_path
from advtex_contract.jobs import JobState, JobView, ResultFile

DATA = b"0123456789" * 1000


@pytest.fixture
def server() -> FakeServer:
    made = FakeServer()
    made.jobs["j0"] = view("j0")
    return made


@pytest.fixture
def client(server: FakeServer) -> Iterator[Client]:
    with Client("http://server.test", "k", transport=server.transport) as made:
        yield made


@pytest.fixture
def job(server: FakeServer) -> JobView:
    return server.finish("j0", {"model.obj": DATA, "previews/front.png": b"png"})


def part_of(folder: Path, data: bytes = DATA) -> Path:
    return folder / f".model.obj.{hashlib.sha256(data).hexdigest()[:16]}.part"


def test_files_and_sub_folders_arrive(client: Client, job: JobView, tmp_path: Path) -> None:
    paths = client.download_results(job, tmp_path / "new" / "out")
    assert [path.read_bytes() for path in paths] == [DATA, b"png"]
    assert paths[1] == tmp_path / "new" / "out" / "previews" / "front.png"
    assert not list(tmp_path.rglob("*.part"))


def test_a_lost_connection_is_continued_with_a_range(
    server: FakeServer, client: Client, job: JobView, tmp_path: Path
) -> None:
    server.faults = [cuts_off(DATA[:3000]), breaks]
    (path,) = client.download_results(job, tmp_path, names=["model.obj"])
    assert path.read_bytes() == DATA
    ranges = [request.headers.get("Range") for request in server.requests]
    assert ranges == [None, "bytes=3000-", "bytes=3000-"]
    assert server.requests[-1].headers["If-Range"] == f'"{job.results[0].sha256}"'


def test_an_earlier_run_s_part_is_continued(server: FakeServer, job: JobView, tmp_path: Path) -> None:
    with Client("http://server.test", "k", retries=0, transport=server.transport) as client:
        server.faults = [cuts_off(DATA[:5000])]
        with pytest.raises(NetworkError):
            client.download_results(job, tmp_path, names=["model.obj"])
    assert part_of(tmp_path).read_bytes() == DATA[:5000]
    assert not (tmp_path / "model.obj").exists()
    seen: list[int] = []
    with Client("http://server.test", "k", transport=server.transport) as client:
        client.download_results(job, tmp_path, names=["model.obj"], on_bytes=lambda _file, done: seen.append(done))
    assert server.requests[-1].headers["Range"] == "bytes=5000-"
    assert seen[0] > 5000
    assert (tmp_path / "model.obj").read_bytes() == DATA


@pytest.mark.parametrize("part", [b"x" * 4000, b"x" * len(DATA), b"x" * (len(DATA) + 5)])
def test_a_part_that_is_damaged_starts_over(client: Client, job: JobView, tmp_path: Path, part: bytes) -> None:
    part_of(tmp_path).write_bytes(part)
    (path,) = client.download_results(job, tmp_path, names=["model.obj"])
    assert path.read_bytes() == DATA


def test_a_server_that_ignores_ranges_is_fine(server: FakeServer, client: Client, job: JobView, tmp_path: Path) -> None:
    part_of(tmp_path).write_bytes(DATA[:4000])
    server.faults = [lambda _: httpx.Response(200, content=DATA)]
    (path,) = client.download_results(job, tmp_path, names=["model.obj"])
    assert path.read_bytes() == DATA


def test_content_that_does_not_match_is_thrown_away(
    server: FakeServer, client: Client, job: JobView, tmp_path: Path
) -> None:
    server.results["model.obj"] = DATA[:-1] + b"X"
    with pytest.raises(IntegrityError, match="does not match its sha256"):
        client.download_results(job, tmp_path, names=["model.obj"])
    assert not (tmp_path / "model.obj").exists()
    assert part_of(tmp_path).stat().st_size == 0


def test_what_is_there_already_is_not_fetched_again(
    server: FakeServer, client: Client, job: JobView, tmp_path: Path
) -> None:
    client.download_results(job, tmp_path)
    before = len(server.requests)
    client.download_results(job, tmp_path)
    assert len(server.requests) == before
    (tmp_path / "model.obj").write_bytes(DATA[:-1] + b"X")
    client.download_results(job, tmp_path)
    assert (tmp_path / "model.obj").read_bytes() == DATA


def test_an_older_file_stays_until_the_new_one_is_whole(server: FakeServer, job: JobView, tmp_path: Path) -> None:
    (tmp_path / "model.obj").write_bytes(b"older")
    with Client("http://server.test", "k", retries=0, transport=server.transport) as client:
        server.faults = [refuses]
        with pytest.raises(NetworkError):
            client.download_results(job, tmp_path, names=["model.obj"])
    assert (tmp_path / "model.obj").read_bytes() == b"older"


def test_a_job_without_results_and_an_unknown_name_are_said(client: Client, job: JobView, tmp_path: Path) -> None:
    with pytest.raises(ClientError, match=r"has no result 'model\.fbx'; it has model\.obj"):
        client.download_results(job, tmp_path, names=["model.fbx"])
    with pytest.raises(ClientError, match="has no results"):
        client.download_results(view("j1"), tmp_path)


BAD_NAMES = [
    "../evil",
    "a/../../evil",
    "/etc/passwd",
    "..",
    ".",
    "",
    "a//b",
    "a/",
    "C:evil",
    "a\\..\\evil",
    "x\0y",
    "x\ny",
    "nul",
    "COM1.txt",
    "model.obj.",
    "model.obj ",
]


@pytest.mark.parametrize("name", BAD_NAMES)
def test_unsafe_names_stop_everything_before_the_first_byte(
    server: FakeServer, client: Client, job: JobView, tmp_path: Path, name: str
) -> None:
    evil = job.results[0].model_copy(update={"name": name})
    harmed = job.model_copy(update={"results": [*job.results, evil]})
    with pytest.raises(IntegrityError, match="not a safe file name"):
        client.download_results(harmed, tmp_path / "out")
    assert server.requests == []
    assert not (tmp_path / "out").exists()


@given(st.text(max_size=30))
def test_whatever_the_name_the_target_lies_below_the_folder(name: str) -> None:
    folder = Path("/srv/out")
    try:
        target = target_path(folder, name)
    except IntegrityError:
        return
    assert folder in target.parents
    assert ".." not in target.parts


@pytest.mark.parametrize("url", ["http://elsewhere.test/x", "https://server.test/x", "//elsewhere.test/x"])
def test_the_key_goes_to_no_other_server(
    server: FakeServer, client: Client, job: JobView, tmp_path: Path, url: str
) -> None:
    lured = job.model_copy(update={"results": [job.results[0].model_copy(update={"url": url})]})
    with pytest.raises(IntegrityError, match="nothing was fetched"):
        client.download_results(lured, tmp_path)
    assert server.requests == []


def test_an_empty_result_is_a_file_too(server: FakeServer, client: Client, tmp_path: Path) -> None:
    job = server.finish("j0", {"empty.txt": b""})
    (path,) = client.download_results(job, tmp_path)
    assert path.read_bytes() == b""


def named(*names: str) -> JobView:
    files = [ResultFile(name=name, size=1, sha256="0" * 64, content_type="x", url="/") for name in names]
    return view("j0", JobState.succeeded).model_copy(update={"results": files})


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("mobile", ["model_mobile.glb"]),
        ("glb,usdz", ["model.glb", "model.usdz"]),
        ("model.mtl, mobile", ["model.mtl", "model_mobile.glb"]),
        ("obj", ["model.obj", "model.mtl", "model.png"]),
        ("tiles,draco,webp", ["model.3tz", "model_draco.glb", "model_webp.glb"]),
        ("3tz", ["model.3tz"]),
        ("previews", ["previews/0.jpg"]),
        ("json", ["report.json"]),
    ],
)
def test_files_are_chosen_by_name_kind_and_ending(words: str, found: list[str]) -> None:
    names = ("model.obj", "model.mtl", "model.png", "model.glb", "model_mobile.glb", "model.usdz")
    names += ("model.3tz", "model_draco.glb", "model_webp.glb")
    assert only_results(named(*names, "previews/0.jpg", "report.json"), words) == found


def test_a_word_that_no_file_answers_to_is_said_with_those_that_there_are() -> None:
    with pytest.raises(ClientError, match=r"no result 'fbx'; give a file's name, its ending, or one of obj, mobile"):
        only_results(named("model.obj", "model_mobile.glb"), "mobile,fbx")


def test_the_kind_that_the_server_tells_counts() -> None:
    job = named("later.bin")
    job.results[0].kind = "splats"
    assert only_results(job, "splats") == ["later.bin"]
