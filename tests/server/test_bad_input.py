"""Bad input over HTTP: each gets one clear error that names the place and the remedy, and the server lives on."""

from __future__ import annotations

import math
import stat
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from advtex_server.settings import ServerSettings

TESTS = Path(__file__).parents[1]
NAN = math.nan
pytestmark = pytest.mark.one_machine("what is in a scan is judged alike wherever it lies")


@pytest.fixture(scope="module")
def load(pytestconfig: pytest.Config) -> Callable[[Path], ModuleType]:
    """The loader of tests/conftest.py: tests are no packages."""
    shared = pytestconfig.pluginmanager.get_plugin(str(TESTS / "conftest.py"))
    assert shared is not None
    loader: Callable[[Path], ModuleType] = shared.load
    return loader


@pytest.fixture(scope="module")
def live(load: Callable[[Path], ModuleType], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """One server for all of this module, so that each case meets what the ones before it left behind."""
    settings = ServerSettings(
        data_dir=tmp_path_factory.mktemp("data"), redis_url="redis://127.0.0.1:1/0", disk_reserve_bytes=0
    )
    server = load(TESTS / "server" / "conftest.py").Live(settings)
    server.start()
    yield server
    server.stop()


@pytest.fixture
def scan(load: Callable[[Path], ModuleType], tmp_path: Path) -> Any:
    """A sound scan, to be spoiled; `scan.make` holds the makers of its files."""
    makers = load(TESTS / "scan" / "conftest.py")
    scan = makers.ScanMaker(tmp_path).native()
    scan.make, scan.load = makers.Bytes, load
    return scan


# How a scan is spoiled: its parts are changed, or the bytes to upload are given


def put(path: str, content: Callable[[Any], bytes]) -> Callable[[Any], None]:
    """One file, replaced or added; `content` is given the makers of files."""
    return lambda scan: scan.files.update({path: content(scan.make)})


def not_a_zip(scan: Any) -> bytes:
    return b"no zip at all" * 1000


def truncated(scan: Any) -> bytes:
    data: bytes = scan.zip().read_bytes()
    return data[: len(data) // 2]


def symlink(scan: Any) -> bytes:
    path: Path = scan.zip()
    link = zipfile.ZipInfo("color/link.png")
    link.create_system, link.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(link, "/etc/passwd")
    return path.read_bytes()


def million_entries(scan: Any) -> bytes:
    return bytes(scan.load(TESTS / "scan" / "test_archive.py").million_entries(1_000_000))


def duplicate(scan: Any) -> bytes:
    path: Path = scan.zip()
    with zipfile.ZipFile(path, "a") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        archive.writestr("mesh.ply", b"another one")
    return path.read_bytes()


def overlap(scan: Any) -> bytes:
    """Two entries of the directory that share one member's bytes: a bomb without recursion."""
    data = bytearray(scan.zip().read_bytes())
    first = data.index(b"PK\x01\x02")
    second = data.index(b"PK\x01\x02", first + 1)
    data[second + 42 : second + 46] = data[first + 42 : first + 46]
    return bytes(data)


def encrypted(scan: Any) -> bytes:
    data = bytearray(scan.zip().read_bytes())
    data[data.index(b"PK\x01\x02") + 8] |= 1
    return bytes(data)


def nan_in_a_pose(scan: Any) -> None:
    scan.scan["frames"][1]["camera_to_world"][0][3] = NAN


def nan_in_all_poses(scan: Any) -> None:
    for frame in scan.scan["frames"]:
        frame["camera_to_world"] = [[NAN] * 4] * 4


def cameras_look_away(scan: Any) -> None:
    for frame in scan.scan["frames"]:
        for row in frame["camera_to_world"][:3]:  # half a turn about the camera's y axis
            row[0], row[2] = -row[0], -row[2]


@pytest.mark.parametrize(
    ("spoil", "code", "where"),
    [
        (not_a_zip, "not_a_zip", "scan.zip"),
        (truncated, "not_a_zip", "scan.zip"),
        (put("../up.txt", lambda _: b"x"), "unsafe_name", "../up.txt"),
        (put("/etc/passwd", lambda _: b"x"), "unsafe_name", "/etc/passwd"),
        (symlink, "link_or_device", "color/link.png"),
        (million_entries, "too_many_entries", "scan.zip"),
        (duplicate, "duplicate_name", "mesh.ply"),
        (encrypted, "encrypted", "?"),
        (overlap, "overlap", "?"),
        (put("more.zip", lambda _: b"PK"), "nested_archive", "more.zip"),
        (put("..\\up.txt", lambda _: b"x"), "unsafe_name", "..\\\\up.txt"),
        (put("zeros.bin", lambda _: bytes(8 << 20)), "compression_ratio", "zeros.bin"),
        (put("color/2.png", lambda _: b"hello"), "not_an_image", "color/2.png"),
        (put("color/2.png", lambda make: make.png(15_000, 15_000)), "image_too_large", "color/2.png"),
        (put("color/2.png", lambda make: make.png()[:-20]), "truncated_image", "color/2.png"),
        (put("depth/2.png", lambda make: make.depth_png()[:-20]), "truncated_image", "depth/2.png"),
        (put("depth/2.png", lambda make: make.depth_png(16, 12)), "depth_size", "depth/2.png"),
        (nan_in_a_pose, "bad_pose", "scan.json: frames[1].camera_to_world"),
        (nan_in_all_poses, "too_few_frames", ""),
        (put("mesh.ply", lambda make: make.ply(faces=[])), "mesh_no_faces", "mesh.ply"),
        (put("mesh.ply", lambda make: make.ply(faces=[(0, 1, 2), (0, 1, 8)])), "mesh_index", "mesh.ply"),
        (put("mesh.ply", lambda make: make.ply([(NAN, 0, 0), *make.corners[1:]])), "mesh_nan", "mesh.ply"),
        (put("mesh.ply", lambda make: make.ply(faces=[(0, 0, 1), (2, 2, 2)])), "mesh_zero_area", "mesh.ply"),
        (cameras_look_away, "mesh_unseen", "mesh.ply"),
    ],
    ids=lambda value: value if isinstance(value, str) else value.__name__.replace("<lambda>", "put"),
)
def test_a_bad_scan(
    live: Any, scan: Any, capsys: pytest.CaptureFixture[str], spoil: Callable[[Any], Any], code: str, where: str
) -> None:
    job = live.job(live.upload(spoil(scan) or scan.zip().read_bytes()))
    assert (job["state"], job["error"]["code"]) == ("rejected", "invalid_scan")
    errors = [detail for detail in job["error"]["details"] if detail["severity"] == "error"]
    if where == "?":  # one of the members, whichever the zip has there
        where = errors[0]["where"]
    assert [(error["code"], error["where"]) for error in errors] == [(code, where)]
    assert errors[0]["remedy"]
    named = f"{where} {errors[0]['message']}".strip()
    assert job["error"]["message"] == f"the scan cannot be textured: {named}"
    if not where:  # an error of the scan as a whole: what it comes from is told beside it, by place
        assert "5 lost tracking" in named
        assert any(detail["where"].startswith("scan.json: frames[0]") for detail in job["error"]["details"])
    lives_on(live, capsys)


@pytest.mark.parametrize(
    ("spec", "where"),
    [
        ({"options": {"steps": 0}}, "body.options.steps"),
        ({"options": {"width": 5000, "height": 64}}, "body.options.width"),
        ({"options": {"preset": "fastest"}}, "body.options.preset"),
        ({"options": {"method": "magic"}}, "body.options.method"),
        ({"options": {"wdith": 640}}, "body.options.wdith"),
        ({"lable": "chair"}, "body.lable"),
    ],
    ids=["below", "above", "preset", "method", "option-name", "field-name"],
)
def test_a_bad_request(
    live: Any, is_error: Any, capsys: pytest.CaptureFixture[str], spec: dict[str, Any], where: str
) -> None:
    response = live.http.post("/v1/jobs", json={"upload_id": live.upload(), **spec})
    message = is_error(response, 422, "invalid_options" if "options" in spec else "bad_request")
    assert message.startswith(f"{where}: ")
    assert [detail["where"] for detail in response.json()["details"]] == [where]
    assert response.json()["details"][0]["remedy"]
    lives_on(live, capsys)


@pytest.mark.parametrize("key", [None, "adv_", "adv_000000000000_" + "a" * 40], ids=["none", "malformed", "unknown"])
def test_a_wrong_key(live: Any, is_error: Any, capsys: pytest.CaptureFixture[str], key: str | None) -> None:
    with live.client(key) as stranger:
        for response in (
            stranger.post("/v1/uploads", content=b"x"),
            stranger.post("/v1/jobs", json={"upload_id": live.upload()}),
        ):
            assert "key" in is_error(response, 401, "unauthorized")
            (detail,) = response.json()["details"]
            assert detail["where"] == "Authorization"
            assert detail["remedy"]
    lives_on(live, capsys)


def test_a_full_disk(make_live: Any, is_error: Any) -> None:
    live = make_live(disk_reserve_bytes=1 << 60)
    response = live.http.post("/v1/uploads", content=b"bytes")
    is_error(response, 507, "insufficient_storage")
    (detail,) = response.json()["details"]
    assert "disk" in detail["where"]
    assert "room" in detail["remedy"]


def test_two_uploads_with_one_idempotency_key(live: Any, is_error: Any) -> None:
    first, second = live.upload(), live.upload()
    live.job(first, key="once")
    response = live.http.post("/v1/jobs", json={"upload_id": second}, headers={"Idempotency-Key": "once"})
    is_error(response, 422, "idempotency_mismatch")
    (detail,) = response.json()["details"]
    assert detail["where"] == "Idempotency-Key"
    assert detail["remedy"]


def test_after_all_of_it_the_same_server_takes_a_good_scan(
    live: Any, scan: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    job = live.job(live.upload(scan.zip().read_bytes()))
    assert (job["state"], job["error"]) == ("queued", None)
    lives_on(live, capsys)


def lives_on(live: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """Ready, and without a traceback in its log."""
    assert live.http.get("/readyz").status_code == 200
    assert "Traceback" not in "".join(capsys.readouterr())
