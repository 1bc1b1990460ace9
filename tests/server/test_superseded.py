"""Requests that have lost an upload to a newer one: nothing of theirs gets into its blob, or completes it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from advtex_server.intake import Intake, Receiving
from advtex_server.refusal import ApiError
from advtex_server.settings import ServerSettings
from advtex_store import keys
from advtex_store.accounts import Caller
from advtex_store.bucket import Bucket
from advtex_store.errors import BlobsUnavailable, RecordNotFound, StoreError, Superseded
from advtex_store.models import UploadRow
from advtex_store.store import Store, open_store

OWNER = "o"
CALLER = Caller("k", OWNER, frozenset())
PART = 8
SIZE = 21


@pytest.fixture(autouse=True)
def _small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    import moto.s3.models

    monkeypatch.setattr("advtex_store.s3_partial.PART", PART)
    monkeypatch.setattr(moto.s3.models, "S3_UPLOAD_PART_MIN_SIZE", PART)
    monkeypatch.setattr("advtex_server.intake.KEEP_BYTES", 4)


@pytest.fixture
def store(tmp_path: Path, place: dict[str, str], sqlite_url: str) -> Iterator[Store]:
    store = open_store(ServerSettings(data_dir=tmp_path, **{"database_url": sqlite_url, **place}))
    store.accounts.create_key(owner=OWNER)
    yield store
    store.close()


@pytest.fixture
def servers(store: Store) -> list[Intake]:
    """Two server processes of one store, as far as uploads know."""
    return [Intake(store, ServerSettings(disk_reserve_bytes=0)) for _ in range(2)]


def stored(store: Store, upload_id: str) -> bytes:
    return b"".join(store.blobs.stream(keys.scan_key(upload_id)))


def is_sound(store: Store, row: UploadRow) -> bool:
    return hashlib.sha256(stored(store, row.id)).hexdigest() == row.sha256


def test_a_superseded_request_completes_nothing(store: Store, servers: list[Intake]) -> None:
    row = servers[0].create(CALLER, SIZE, "a.zip")
    older = servers[0].resume(OWNER, row.id)
    older.write(b"A" * 10)
    newer = servers[1].resume(OWNER, row.id)
    with pytest.raises(Superseded):
        older.write(b"A" * (SIZE - 10))
    with suppress(Superseded):
        assert not older.end().complete
    assert store.uploads.upload(row.id).sha256 is None
    newer.write(b"B" * (SIZE - newer.kept))
    assert newer.end().complete
    assert is_sound(store, store.uploads.upload(row.id))
    older.close()
    newer.close()
    assert stored(store, row.id) == b"A" * newer.row.offset + b"B" * (SIZE - newer.row.offset)


def test_a_superseded_request_forgets_nothing(store: Store, servers: list[Intake]) -> None:
    """Its upload was to be all or nothing, and its line breaks after another client has gone on with it."""
    row = servers[0].create(CALLER, SIZE, "a.zip")
    older = servers[0].resume(OWNER, row.id)
    older.write(b"A" * 10)
    with servers[1].resume(OWNER, row.id)._partial:
        servers[0].forget(row.id, older.row.holder)
    assert servers[1].offset(OWNER, row.id).offset == 10
    older.close()


def test_an_upload_that_is_decided_is_completed_by_whoever_asks(
    store: Store, servers: list[Intake], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server dies right after the row was told of all bytes, another one right after the blob got its name."""
    for dies in ("publish", "finish"):
        row = servers[0].create(CALLER, SIZE, "a.zip")
        first = servers[0].resume(OWNER, row.id)
        first.write(b"A" * SIZE)
        with monkeypatch.context() as patched:
            patched.setattr(first._partial if dies == "publish" else store.uploads, dies, refuse)
            with pytest.raises(BlobsUnavailable):
                first.end()
        late = servers[1].resume(OWNER, row.id)
        with pytest.raises((ApiError, ValueError)):
            late.write(b"B")
        late.close()
        whole = servers[1].offset(OWNER, row.id)
        assert (whole.offset, whole.sha256) == (SIZE, hashlib.sha256(b"A" * SIZE).hexdigest())
        assert stored(store, row.id) == b"A" * SIZE
        assert first.end().complete, "it is the same blob whoever completes it"
        first.close()


def refuse(*_: object) -> None:
    raise BlobsUnavailable("away")


class Late:
    """Writes that were under way when their request lost the upload, and that come to the storage later."""

    def __init__(self) -> None:
        self.catch = False
        self.caught: list[Callable[[], object]] = []

    @contextmanager
    def instead_of(self, kind: type, name: str) -> Iterator[None]:
        real = getattr(kind, name)

        def write(*arguments: Any) -> object:
            if not self.catch:
                return real(*arguments)
            self.caught.append(lambda: real(*arguments))
            raise BlobsUnavailable("nothing is known of it")

        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(kind, name, write)
            yield

    def come(self, number: int) -> None:
        with suppress(StoreError):
            self.caught.pop(number % len(self.caught))()


class World:
    """Clients with bytes of their own send to one upload through two servers; `durable` is what was acknowledged."""

    def __init__(self, store: Store, servers: list[Intake], late: Late) -> None:
        self.store, self.servers, self.late = store, servers, late
        self.upload_id = servers[0].create(CALLER, SIZE, "a.zip").id
        self.requests: list[tuple[Receiving, bytearray]] = []
        self.durable = b""

    def begin(self, number: int) -> None:
        receiving = self.servers[number % 2].resume(OWNER, self.upload_id)
        if receiving.row.offset == SIZE:
            receiving.end()
            receiving.close()
            return
        assert receiving.row.offset in range(len(self.durable) + 1)
        if receiving.row.offset < len(self.durable):
            assert "s3" in type(receiving._partial).__module__, "a folder goes back for nothing"
            self.durable = self.durable[: receiving.row.offset]
        self.requests.append((receiving, bytearray(self.durable)))

    def write(self, number: int) -> None:
        receiving, seen = self.pick(number)
        data = bytes([len(self.requests) + number % 7]) * min(number % 7 + 1, SIZE - len(seen))
        if not data:
            return
        seen += data
        before = receiving.kept
        try:
            receiving.write(data)
            self.note(receiving, before, seen)
        except StoreError:
            receiving.abandon()
            self.note(receiving, before, seen)
            self.drop(receiving)

    def write_late(self, number: int) -> None:
        self.late.catch = True
        try:
            self.write(number)
        finally:
            self.late.catch = False

    def end(self, number: int) -> None:
        receiving, seen = self.pick(number)
        before = receiving.kept
        try:
            receiving.end()
        finally:
            self.note(receiving, before, seen)
            self.drop(receiving)

    def die(self, number: int) -> None:
        self.drop(self.pick(number)[0])

    def ask(self, number: int) -> None:
        row = self.servers[number % 2].offset(OWNER, self.upload_id)
        assert row.offset < SIZE or row.sha256 is not None, "a client that sees all of its bytes would stop here"

    def come(self, number: int) -> None:
        if self.late.caught:
            self.late.come(number)

    def note(self, receiving: Receiving, before: int, seen: bytearray) -> None:
        if receiving.kept != before:
            self.durable = bytes(seen[: receiving.kept])

    def pick(self, number: int) -> tuple[Receiving, bytearray]:
        if not self.requests:
            raise RecordNotFound("none is open")
        return self.requests[number % len(self.requests)]

    def drop(self, receiving: Receiving) -> None:
        receiving.close()
        self.requests = [pair for pair in self.requests if pair[0] is not receiving]

    def check(self) -> None:
        row = self.store.uploads.upload(self.upload_id)
        if row.sha256 is not None:
            assert stored(self.store, row.id) == self.durable
            assert is_sound(self.store, row)

    def finish(self) -> None:
        """One client is left, and completes it, although the last late writes come in between."""
        for receiving, _ in self.requests:
            receiving.close()
        number = 0
        while self.store.uploads.upload(self.upload_id).sha256 is None:
            number += 1
            assert number < 20
            with suppress(Superseded, BlobsUnavailable):  # complete; parts were replaced
                receiving = self.servers[number % 2].resume(OWNER, self.upload_id)
                try:
                    self.durable = self.durable[: receiving.row.offset]
                    data = b"z" * (SIZE - receiving.row.offset)
                    if data:
                        receiving.write(data)
                        self.durable += data
                    self.come(number)
                    receiving.end()
                finally:
                    receiving.close()
            self.check()
        while self.late.caught:
            self.come(0)
            self.check()


ACTIONS = st.lists(
    st.tuples(
        st.sampled_from(["begin", "write", "write", "write late", "come", "end", "die", "ask"]), st.integers(0, 99)
    ),
    max_size=40,
)


@settings(
    max_examples=60,
    deadline=None,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(actions=ACTIONS)
def test_the_stored_bytes_are_always_what_was_acknowledged(
    store: Store, servers: list[Intake], actions: list[tuple[str, int]]
) -> None:
    late = Late()
    with late.instead_of(Bucket, "put_part"), late.instead_of(Bucket, "put"), late.instead_of(Bucket, "complete"):
        world = World(store, servers, late)
        for name, number in actions:
            with suppress(StoreError, ApiError):
                getattr(world, name.replace(" ", "_"))(number)
            world.check()
        world.finish()
