"""Scans by reference: what lies below an allowed root is found, and nothing else is ever looked at."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from advtex_server.errors import translated
from advtex_store.bucket import Bucket
from advtex_store.errors import BlobNotFound, ReferenceRefused, ReferenceUnreadable
from advtex_store.references import References

NOBODY = 65534


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """`root/scans` is allowed; `root/secret` is not."""
    root = tmp_path / "root"
    for name in ("scans/a/scan.json", "scans/with space/scan.json", "secret/scan.json", "scans-2/scan.json"):
        (root / name).parent.mkdir(parents=True)
        (root / name).write_text(name)
    (root / "scans" / "b.zip").write_bytes(b"zip")
    return root


@pytest.fixture
def references(tree: Path) -> References:
    return References([(tree / "scans").as_uri()])


def test_what_lies_below_a_root_is_used_in_place(tree: Path, references: References, tmp_path: Path) -> None:
    scans = tree / "scans"
    for path in (scans / "a", scans / "b.zip", scans / "with space"):
        assert references.fetch(path.as_uri(), tmp_path / "copy") == path
    assert references.fetch(f"file://localhost{scans}/a/", tmp_path) == scans / "a"
    assert not (tmp_path / "copy").exists()
    with pytest.raises(BlobNotFound, match="nothing at"):
        references.fetch((scans / "none").as_uri(), tmp_path)


@contextmanager
def as_nobody() -> Iterator[None]:
    """Rights mean nothing to root."""
    if os.geteuid() != 0:
        yield
        return
    os.setegid(NOBODY)
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)
        os.setegid(0)


@pytest.mark.parametrize("locked", ["a", "b.zip", "."])
def test_what_the_service_has_no_right_to_read_says_so(locked: str) -> None:
    with tempfile.TemporaryDirectory() as folder:  # pytest's own is closed to others
        root = Path(folder)
        root.chmod(0o755)
        (root / "scans" / "a").mkdir(parents=True)
        (root / "scans" / "a" / "scan.json").write_text("{}")
        (root / "scans" / "b.zip").write_bytes(b"zip")
        references = References([(root / "scans").as_uri()])
        (root / "scans" / locked).chmod(0)
        url = (root / "scans" / ("a" if locked == "." else locked)).as_uri()
        with (
            as_nobody(),
            pytest.raises(ReferenceUnreadable, match=r"cannot be read by the service \(Permission denied\)"),
        ):
            references.fetch(url, root / "copy")
        (root / "scans" / locked).chmod(0o755)
        with as_nobody():
            assert references.fetch(url, root / "copy").exists()
    told = translated(ReferenceUnreadable("no right"))
    assert (told.status, told.body.code) == (422, "invalid_source")


REFUSED = {
    "another folder": "file://{root}/secret",
    "dots": "file://{root}/scans/../secret",
    "encoded dots": "file://{root}/scans/%2e%2e/secret",
    "encoded slashes": "file://{root}/scans/..%2fsecret",
    "twice encoded": "file://{root}/scans/%252e%252e/secret",
    "a name that begins alike": "file://{root}/scans-2",
    "above the root": "file://{root}",
    "everything": "file:///",
    "a device": "file:///dev/zero",
    "an empty part": "file://{root}/scans//a",
    "nul": "file://{root}/scans/a%00",
    "newline": "file://{root}/scans/a%0a",
    "backslash": "file://{root}/scans/..%5csecret",
    "not utf-8": "file://{root}/scans/%ff",
    "a host": "file://elsewhere/{root}/scans/a",
    "a query": "file://{root}/scans/a?x",
    "a fragment": "file://{root}/scans/a#x",
    "no scheme": "{root}/scans/a",
    "http": "http://127.0.0.1/scan.zip",
    "a bucket that was not allowed": "s3://scans/a",
    "a malformed host": "file://[::1",
    "nothing": "",
}


@pytest.mark.parametrize("url", REFUSED.values(), ids=REFUSED.keys())
def test_everything_else_is_refused(tree: Path, references: References, tmp_path: Path, url: str) -> None:
    with pytest.raises((ReferenceRefused, BlobNotFound)) as caught:
        references.fetch(url.format(root=tree), tmp_path / "copy")
    if "%25" not in url:
        assert caught.type is ReferenceRefused


def test_links_are_followed_before_they_are_judged(tree: Path, references: References, tmp_path: Path) -> None:
    scans = tree / "scans"
    (scans / "out").symlink_to(tree / "secret")
    (scans / "in").symlink_to(scans / "a")
    (scans / "loop").symlink_to(scans / "loop")
    for name in ("out", "out/scan.json", "loop", "loop/x"):
        with pytest.raises(ReferenceRefused):
            references.fetch((scans / name).as_uri(), tmp_path)
    assert references.fetch((scans / "in").as_uri(), tmp_path) == scans / "a"


def test_a_root_that_is_a_link_allows_what_it_leads_to(tree: Path, tmp_path: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to(tree / "scans")
    references = References([link.as_uri()])
    assert references.fetch(f"{link.as_uri()}/a", tmp_path) == tree / "scans" / "a"
    link.unlink()
    link.symlink_to(tree / "secret")
    with pytest.raises(ReferenceRefused):
        references.fetch(f"{link.as_uri()}/scan.json", tmp_path)


def test_without_roots_everything_is_refused(tree: Path, tmp_path: Path) -> None:
    with pytest.raises(ReferenceRefused, match="the operator allowed none"):
        References([]).fetch((tree / "scans").as_uri(), tmp_path)


def test_whether_something_outside_exists_is_not_told(tree: Path, references: References, tmp_path: Path) -> None:
    messages = []
    for name in ("secret", "nothing"):
        with pytest.raises(ReferenceRefused) as caught:
            references.fetch(f"file://{tree}/{name}", tmp_path)
        messages.append(str(caught.value).replace(name, "X"))
    assert messages[0] == messages[1]


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.sampled_from(["..", ".", "", "a", "%2e%2e", "%2f", "%5c", "secret", "out", "scan.json", "%00"])))
def test_no_url_leads_out_of_the_roots(tree: Path, references: References, tmp_path: Path, parts: list[str]) -> None:
    link = tree / "scans" / "out"
    if not link.is_symlink():
        link.symlink_to(tree / "secret")
    try:
        found = references.fetch(f"file://{tree}/scans/" + "/".join(parts), tmp_path)
    except (ReferenceRefused, BlobNotFound):
        return
    assert Path(os.path.realpath(found)).is_relative_to(tree / "scans")


# Object storage


@pytest.fixture
def bucket(s3_url: str) -> str:
    """A bucket with `public/a/…` (a folder), `public/b.zip`, and `private/…`. -> its name"""
    name = s3_url.removeprefix("s3://").partition("/")[0]
    store = Bucket(name, "")
    for key in ("public/a/scan.json", "public/a/color/0 1.png", "public/b.zip", "public-2/x", "private/scan.json"):
        store.put(key, key.encode())
    return name


def test_objects_are_copied(bucket: str, tmp_path: Path) -> None:
    references = References([f"s3://{bucket}/public"])
    folder = references.fetch(f"s3://{bucket}/public/a", tmp_path / "one")
    found = {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*") if path.is_file()}
    assert found == {"scan.json": "public/a/scan.json", "color/0 1.png": "public/a/color/0 1.png"}
    assert folder.name == "a"
    archive = references.fetch(f"s3://{bucket}/public/b.zip", tmp_path / "two")
    assert (archive.name, archive.read_bytes()) == ("b.zip", b"public/b.zip")
    with pytest.raises(BlobNotFound, match="nothing at"):
        references.fetch(f"s3://{bucket}/public/none", tmp_path)


def test_copies_have_the_times_of_the_objects(bucket: str, tmp_path: Path) -> None:
    """So that a later attempt, which copies again, can tell whether it has the same scan."""
    references = References([f"s3://{bucket}/public"])

    def times(copy: str) -> dict[str, int]:
        folder = references.fetch(f"s3://{bucket}/public/a", tmp_path / copy)
        return {path.name: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}

    first = times("first")
    assert times("second") == first
    store = Bucket(bucket, "")
    written = store.head("public/a/scan.json").modified
    while store.head("public/a/scan.json").modified == written:  # a HEAD states whole seconds
        store.put("public/a/scan.json", b"public/a/SCAN.json")
    changed = times("third")
    assert {name for name in changed if changed[name] != first[name]} == {"scan.json"}


@pytest.mark.parametrize(
    "path", ["private", "private/scan.json", "public-2/x", "public/../private", "public/%2e%2e/private", "public/a?x"]
)
def test_objects_elsewhere_are_refused(bucket: str, tmp_path: Path, path: str) -> None:
    with pytest.raises(ReferenceRefused):
        References([f"s3://{bucket}/public"]).fetch(f"s3://{bucket}/{path}", tmp_path)


def test_objects_whose_names_would_leave_the_folder_are_refused(bucket: str, tmp_path: Path) -> None:
    import boto3

    client = boto3.client("s3", endpoint_url=os.environ["AWS_ENDPOINT_URL"])
    client.put_object(Bucket=bucket, Key="public/c/..\\..\\evil", Body=b"x")
    with pytest.raises(ReferenceRefused, match="backslash"):
        References([f"s3://{bucket}/public"]).fetch(f"s3://{bucket}/public/c", tmp_path / "copy")
    assert not list(tmp_path.rglob("*evil*"))


def test_a_copy_can_be_ended(bucket: str, tmp_path: Path) -> None:
    class Enough(Exception):
        pass

    def check() -> None:
        raise Enough

    with pytest.raises(Enough):
        References([f"s3://{bucket}/public"]).fetch(f"s3://{bucket}/public/a", tmp_path, check)
