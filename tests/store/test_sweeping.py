"""Orphans are removed, and never anything that a row refers to, whatever happens while they are looked for."""

from __future__ import annotations

import functools
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from checked import queued_job
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from advtex_contract.jobs import JobSpec
from advtex_store import keys
from advtex_store.blobs import Blobs, FolderBlobs
from advtex_store.errors import RecordNotFound, StoreError
from advtex_store.ids import new_id
from advtex_store.models import JobRow, UploadRow
from advtex_store.partials import Hold, Partial, Unpublished
from advtex_store.places import open_blobs
from advtex_store.results import Results
from advtex_store.retention import ORPHAN_SECONDS, SETTLED_SECONDS, Retention
from advtex_store.s3 import S3Blobs
from advtex_store.s3_partial import MULTIPART_SUFFIX

SCAN = b"the bytes of a scan"
SIZE = len(SCAN)


class World:
    """Everything that servers and workers do with rows and blobs, in their order, on a random object."""

    def __init__(self, bench: Any, blobs: Interrupted, folder: Path, data: st.DataObject) -> None:
        self.bench, self.blobs, self.data = bench, blobs, data
        self.retention = Retention(bench.database, blobs)
        # The world goes on inside of what is guarded: nothing that it finds amiss may be passed over.
        self.retention.troubles.of = lambda *_: nullcontext()  # type: ignore[method-assign]
        self.results = Results(bench.records, blobs)
        self.file = folder / "file"
        self.file.write_bytes(b"result")
        self.uploads: list[str] = []
        self.partials: list[tuple[str, Partial]] = []  # of requests that are still open, or died
        self.jobs: list[str] = []
        for begin in (self.begin_upload, self.submit_scan, self.run_job):
            begin()

    def actions(self) -> dict[str, Callable[[], object]]:
        return {
            "begin upload": self.begin_upload,
            "finish upload": self.finish_upload,
            "open request": self.open_request,
            "piece": self.send_piece,
            "last piece": self.send_last_piece,
            "death in mid-request": self.die_in_mid_request,
            "discard upload": self.discard_upload,
            "late upload": self.write_late,
            "create job": self.create_job,
            "submit scan": self.submit_scan,
            "run job": self.run_job,
            "checkpoint": self.checkpoint,
            "succeed": self.succeed,
            "cancel": lambda: self.bench.records.cancel(self.pick(self.jobs)),
            "delete job": self.delete_job,
            "delete upload": lambda: self.bench.uploads.delete(self.pick(self.uploads)),
            "time passes": self.pass_time,
            "expire": self.retention.expire,
            "purge": self.retention.purge,
            "tidy": self.retention.tidy,
        }

    def step(self) -> None:
        """One action, which may be refused."""
        actions = self.actions()
        try:
            actions[self.data.draw(st.sampled_from(sorted(actions)))]()
        except (StoreError, IndexError):
            return

    def pick(self, ids: list[str]) -> str:
        return ids[self.data.draw(st.integers(0, len(ids) - 1))] if ids else ids[0]

    def begin_upload(self) -> None:
        """A row and its first bytes, in a request that stays open."""
        row = self.bench.uploads.create("me", SIZE)
        self.uploads.append(row.id)
        row = self.bench.uploads.seize(row.id, "me")
        self.partials.append((row.holder, self.resumed(row)))
        self.go_on_with(*self.partials[-1])

    def open_request(self) -> None:
        """tus: seize the row, then go on with its bytes."""
        row = self.bench.uploads.seize(self.pick(self.uploads), "me")
        self.partials.append((row.holder, self.resumed(row)))

    def resumed(self, row: UploadRow) -> Partial:
        check = functools.partial(self.bench.uploads.check_held, row.id, row.holder)
        return self.blobs.resume(keys.scan_key(row.id), SIZE, row.offset, Hold(str(row.holder), row.kept_by, check))

    def send_piece(self) -> None:
        self.go_on_with(*self.pick(self.partials))

    def go_on_with(self, holder: str, partial: Partial) -> None:
        row = self.held_by(holder)
        assert partial.offset >= row.offset, "bytes are durable that no writer wrote"
        self.send(row, partial, SCAN[partial.offset : min(partial.offset + 4, SIZE - 1)])

    def send(self, row: UploadRow, partial: Partial, data: bytes) -> None:
        partial.write(data)
        partial.flush()
        self.bench.uploads.advance(row.id, row.holder, partial.offset)
        partial.settle()

    def send_last_piece(self) -> None:
        holder, partial = self.pick(self.partials)
        row = self.held_by(holder)
        self.send(row, partial, SCAN[partial.offset :])
        partial.publish()
        self.bench.uploads.finish(row.id, "ab" * 32, holder)

    def held_by(self, holder: str) -> UploadRow:
        with self.bench.database.read() as session:
            row: UploadRow | None = session.query(UploadRow).filter(UploadRow.holder == holder).one_or_none()
        if row is None:
            raise RecordNotFound("another request has it")
        return row

    def die_in_mid_request(self) -> None:
        """S3 only: between the multipart upload and the blob that has its id; and in the middle of a result."""
        if isinstance(self.blobs, S3Blobs):
            upload, job = self.pick(self.uploads), self.pick(self.jobs)
            self.bench.uploads.upload(upload)
            self.blobs.bucket.begin(keys.scan_key(upload))
            self.bench.records.job(job)
            self.blobs.bucket.begin(keys.result_key(job, 1, "texture.png"))

    def finish_upload(self) -> None:
        upload = self.pick(self.uploads)
        self.bench.uploads.upload(upload)
        self.blobs.put(keys.scan_key(upload), SCAN)
        self.bench.uploads.finish(upload, "ab" * 32)

    def discard_upload(self) -> None:
        """A server that dies between row and blob leaves an orphan."""
        upload = self.pick(self.uploads)
        self.bench.uploads.discard(upload, self.bench.uploads.upload(upload).holder)

    def write_late(self) -> None:
        """A writer that does not know yet that its row is gone."""
        self.blobs.put(keys.scan_key(self.pick(self.uploads)), SCAN)

    def submit_scan(self) -> None:
        """All of an upload, and a job of it."""
        row = self.bench.uploads.create("me", SIZE)
        self.uploads.append(row.id)
        self.blobs.put(keys.scan_key(row.id), SCAN)
        self.bench.uploads.finish(row.id, "ab" * 32)
        self.jobs.append(queued_job(self.bench, "me", JobSpec(upload_id=row.id)))

    def run_job(self) -> None:
        """The newest job is claimed and has a checkpoint."""
        job = self.jobs[-1]
        row = self.bench.records.claim(job, self.bench.records.job(job).attempt, "w")
        self.blobs.put(keys.checkpoint_prefix(job, row.attempt) + "1/0", b"state")

    def create_job(self) -> None:
        spec = JobSpec(upload_id=self.pick(self.uploads))
        self.jobs.append(queued_job(self.bench, "me", spec))

    def checkpoint(self) -> None:
        job = self.pick(self.jobs)
        row = self.bench.records.job(job)
        if row.state == "queued":
            self.bench.records.claim(job, row.attempt, "w")
        self.blobs.put(keys.checkpoint_prefix(job, row.attempt) + "1/0", b"state")

    def succeed(self) -> None:
        job = self.pick(self.jobs)
        self.results.commit(job, self.bench.records.job(job).attempt, {"model.obj": self.file})

    def delete_job(self) -> None:
        self.bench.records.delete(self.pick(self.jobs))

    def pass_time(self) -> None:
        self.bench.clock.now += self.data.draw(st.sampled_from([1.0, SETTLED_SECONDS, 90_000.0]))

    def check(self) -> None:
        """Whatever a row refers to is there; nothing goes on while this looks."""
        self.blobs.calm = True
        try:
            self.check_rows()
        finally:
            self.blobs.calm = False

    def check_rows(self) -> None:
        with self.bench.database.read() as session:
            uploads = session.query(UploadRow).filter(UploadRow.deleted_at.is_(None), UploadRow.sha256.is_not(None))
            for upload in uploads:
                assert self.blobs.is_published(keys.scan_key(upload.id), SIZE), "a scan was removed"
            begun = session.query(UploadRow).filter(UploadRow.deleted_at.is_(None), UploadRow.sha256.is_(None))
            self.check_pieces(begun.filter(UploadRow.offset > 0).all())
            for job in session.query(JobRow).filter(JobRow.deleted_at.is_(None)):
                for entry in job.results:
                    assert self.blobs.exists(entry["key"]), "a result was removed"
                if job.state == "succeeded":
                    assert self.blobs.exists(keys.result_manifest_key(job.id))
                elif job.state == "running":
                    assert self.blobs.exists(keys.checkpoint_prefix(job.id, job.attempt) + "1/0")

    def check_pieces(self, rows: list[UploadRow]) -> None:
        """What the rows call durable can be gone on with."""
        for row in rows:
            self.resumed(row).close()  # else BlobNotFound
        if isinstance(self.blobs, S3Blobs):
            begun = set(self.blobs.bucket.begun("scans"))
            for key in (keys.scan_key(row.id) for row in rows):
                if not self.blobs.is_published(key, SIZE):
                    assert (key, self.blobs.get(key + MULTIPART_SUFFIX).decode()) in begun, "parts were removed"

    def end(self) -> None:
        """Without rows, nothing is kept for long."""
        for _, partial in self.partials:
            partial.close()
        with self.bench.database.write() as session:
            session.query(JobRow).delete()
            session.query(UploadRow).delete()
        self.bench.clock.now += ORPHAN_SECONDS
        self.retention.sweep()
        for prefix in (keys.SCANS, keys.JOBS):
            assert [*self.blobs.list(prefix), *self.blobs.unpublished(prefix)] == []


class Interrupted(Blobs):
    """Lets the world go on between the look at the blobs, the look at the rows, and every removal."""

    world: World
    calm = False

    def folders(self, prefix: str) -> Iterator[str]:
        found = list(super().folders(prefix))
        self.go_on(4)
        return iter(found)

    def unpublished(self, prefix: str) -> Iterator[Unpublished]:
        found = list(super().unpublished(prefix))
        self.go_on(2)
        return iter(found)

    def delete_prefix(self, prefix: str) -> None:
        self.go_on(1)
        super().delete_prefix(prefix)

    def go_on(self, steps: int) -> None:
        for _ in range(0 if self.calm else self.world.data.draw(st.integers(0, steps))):
            self.world.step()


class InterruptedFolder(Interrupted, FolderBlobs): ...


class InterruptedS3(Interrupted, S3Blobs): ...


def live_on(bench: Any, blobs: Interrupted, data: st.DataObject) -> None:
    """A while of everything, with sweeps."""
    with tempfile.TemporaryDirectory() as folder:
        world = blobs.world = World(bench, blobs, Path(folder), data)
        with bench.database.write() as session:  # of an example that hypothesis gave up
            session.query(JobRow).delete()
            session.query(UploadRow).delete()
        for _ in range(data.draw(st.integers(1, 5))):
            for _ in range(data.draw(st.integers(0, 12))):
                world.step()
                world.check()
            world.retention.sweep()
            world.check()
        blobs.calm = True
        world.end()


EXAMPLES = settings(
    max_examples=30,
    phases=[Phase.explicit, Phase.generate],
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
)


@EXAMPLES
@given(data=st.data())
def test_sweeping_never_removes_what_a_row_refers_to(sqlite_bench: Any, data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as folder:
        live_on(sqlite_bench, InterruptedFolder(Path(folder)), data)


@pytest.mark.slow
@settings(EXAMPLES, max_examples=5)
@given(data=st.data())
def test_sweeping_a_bucket_spares_what_a_row_refers_to(
    sqlite_bench: Any, data: st.DataObject, s3_url: str, small_parts: None, tmp_path: Path
) -> None:
    bucket = s3_url.split("/")[2]
    live_on(sqlite_bench, InterruptedS3(bucket, os.urandom(6).hex(), tmp_path), data)


def test_multipart_uploads_whose_writers_died_are_aborted(bench: Any, s3_url: str, tmp_path: Path) -> None:
    blobs = open_blobs(s3_url, tmp_path)
    assert isinstance(blobs, S3Blobs)
    retention = Retention(bench.database, blobs)
    begun, complete, job = bench.uploads.create("me", SIZE).id, bench.finished_upload(), bench.job()
    create = blobs.bucket.begin
    kept = [create(keys.scan_key(begun)), create(keys.result_key(job, 1, "a")), create("scans/by hand/x")]
    for key in (keys.scan_key(new_id(bench.clock.now - ORPHAN_SECONDS)), keys.scan_key(complete)):
        create(key)

    def left() -> list[str]:
        begun = [*blobs.bucket.begun("scans"), *blobs.bucket.begun("jobs")]
        return sorted(upload_id for _, upload_id in begun)

    assert retention.sweep() == 2
    assert left() == sorted(kept), "a writer may have begun them this moment"
    row = bench.uploads.seize(begun, "me")
    blobs.resume(keys.scan_key(begun), SIZE, 0, Hold(row.holder, None, lambda: None)).close()  # the client tries again
    assert retention.sweep() == 1
    assert kept[0] not in left()
    assert len(left()) == 3
    bench.records.cancel(job)
    assert retention.sweep() == 0, "an attempt that was canceled may still be at it"
    bench.clock.now += SETTLED_SECONDS + 1
    assert retention.sweep() == 1
    assert kept[1] not in left()


def test_orphans_go_and_everything_else_stays(bench: Any, blobs: Blobs) -> None:
    retention = Retention(bench.database, blobs)
    upload = bench.finished_upload()
    job = bench.job(upload_id=upload)
    orphan, newer = (new_id(bench.clock.now - age) for age in (ORPHAN_SECONDS, ORPHAN_SECONDS - 1))
    kept = [keys.scan_key(newer), keys.result_manifest_key(newer)]  # of a database that an older one has replaced?
    kept += [keys.scan_key(upload), keys.checkpoint_prefix(job, 1) + "1/0", "scans/not-an-id/x", "elsewhere/x"]
    lost = [keys.scan_key(orphan), keys.checkpoint_prefix(orphan, 1) + "1/0", keys.result_manifest_key(orphan)]
    for key in kept + lost:
        blobs.put(key, b"x")
    assert retention.sweep() == 2
    assert [blobs.exists(key) for key in kept] == [True] * len(kept)
    assert [blobs.exists(key) for key in lost] == [False] * len(lost)
    assert retention.sweep() == 0


def test_what_comes_late_for_a_purged_job_goes_too(bench: Any, blobs: Blobs) -> None:
    retention = Retention(bench.database, blobs)
    job = bench.job()
    bench.records.cancel(job)
    bench.records.delete(job)
    retention.purge()
    for late in (keys.checkpoint_prefix(job, 1) + "1/0", keys.live_key(job, 1)):
        blobs.put(late, b"x")
        assert retention.sweep() == 1
        assert not blobs.exists(late)


def test_leftovers_of_other_attempts_go_and_the_result_stays(bench: Any, blobs: Blobs, tmp_path: Path) -> None:
    retention, results = Retention(bench.database, blobs), Results(bench.records, blobs)
    (tmp_path / "a").write_bytes(b"a")
    job = bench.job()
    bench.records.claim(job, 1, "w")
    for key in (keys.result_key(job, 7, "a"), keys.checkpoint_prefix(job, 1) + "1/0", keys.live_key(job, 1)):
        blobs.put(key, b"late")
    results.commit(job, 1, {"a": tmp_path / "a"})
    assert retention.tidy() == 0, "another attempt may still be at it"
    bench.clock.now += SETTLED_SECONDS + 1
    assert retention.tidy() == 1
    left = [info.key for info in blobs.list(keys.job_prefix(job))]
    assert left == [keys.result_manifest_key(job), keys.result_key(job, 1, "a")]
    assert retention.tidy() == 0


@pytest.mark.parametrize("keep", [60, 5000])
def test_a_job_is_kept_as_long_as_was_announced(bench: Any, blobs: Blobs, keep: int) -> None:
    job = bench.job(retention_seconds=keep)
    bench.records.cancel(job)
    row = bench.records.job(job)
    assert (row.retention_seconds, row.expires_at) == (keep, bench.clock.now + keep)
    retention = Retention(bench.database, blobs)
    bench.clock.now += keep
    retention.expire()
    assert bench.records.job(job).id == job
    bench.clock.now += 1
    retention.expire()
    with pytest.raises(StoreError):
        bench.records.job(job)
