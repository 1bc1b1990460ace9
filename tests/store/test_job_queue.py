"""The RQ queue against a real Redis."""

from __future__ import annotations

import json
import time
import zlib
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
import redis
from rq import Queue, SimpleWorker
from rq.job import Job
from rq.serializers import JSONSerializer

from advtex_store.queue import (
    PRESENCE,
    PRESENCE_SECONDS,
    STARTED_GRACE_SECONDS,
    TASK,
    JobQueue,
    WorkerClass,
    class_of,
    connect_redis,
    queue_name,
)
from advtex_store.settings import StoreSettings


@pytest.fixture
def queue(redis_url: str) -> Any:
    client = connect_redis(StoreSettings(redis_url=redis_url))
    yield JobQueue(client)
    client.close()


def test_an_attempt_is_offered_once(queue: JobQueue) -> None:
    assert not queue.holds("job", 1)
    assert queue.offer("job", 1, 8)
    assert queue.holds("job", 1)
    assert not queue.offer("job", 1, 8)
    assert queue.offer("job", 2, 8)
    assert queue.waiting_ids(8) == ["job-1", "job-2"]
    assert not queue.holds("job", 3)


def test_the_front(queue: JobQueue) -> None:
    queue.offer("a", 1, 8)
    queue.offer("b", 1, 8)
    queue.offer("c", 1, 8, front=True)
    assert queue.waiting_ids(8) == ["c-1", "a-1", "b-1"]


def test_what_is_in_redis(queue: JobQueue) -> None:
    """JSON, the task by name, and nothing that ends a job on its own."""
    queue.offer("job", 1, 8)
    raw = queue.redis.hgetall("rq:job:job-1")
    assert json.loads(zlib.decompress(raw[b"data"])) == [TASK, None, ["job", 1], {}]
    assert raw[b"timeout"] == b"-1"
    assert queue.redis.ttl("rq:job:job-1") == -1


def test_an_emptied_redis_is_filled_again(queue: JobQueue) -> None:
    queue.offer("job", 1, 8)
    queue.redis.flushall()
    assert not queue.holds("job", 1)
    assert queue.offer("job", 1, 8)


def test_an_attempt_whose_worker_died_before_claiming_comes_back(queue: JobQueue) -> None:
    queue.offer("job", 1, 8)
    queue.redis.lpop("rq:queue:advtex-8")
    assert queue.holds("job", 1)
    assert not queue.offer("job", 1, 8)
    job = Job.fetch("job-1", connection=queue.redis, serializer=JSONSerializer)
    job.enqueued_at = datetime.now(UTC) - timedelta(seconds=STARTED_GRACE_SECONDS + 1)
    job.save()
    assert not queue.holds("job", 1)
    assert queue.offer("job", 1, 8)
    assert queue.waiting_ids(8) == ["job-1"]


def test_an_attempt_that_has_waited_for_long_and_was_just_taken_is_held(queue: JobQueue) -> None:
    """The taker has as long for its claim as one of a job that had not waited; then it is held for dead."""
    for _ in range(2):
        queue.offer("job", 1, 8)
        job = Job.fetch("job-1", connection=queue.redis, serializer=JSONSerializer)
        job.enqueued_at = datetime.now(UTC) - timedelta(seconds=10 * STARTED_GRACE_SECONDS)
        job.save()
        taken = Queue(queue_name(8), connection=queue.redis).intermediate_queue
        assert queue.redis.lmove("rq:queue:advtex-8", taken.key) == b"job-1"
        assert not queue.offer("job", 1, 8)
        queue.redis.set(taken.get_first_seen_key("job-1"), time.time() - STARTED_GRACE_SECONDS - 1)
        assert queue.offer("job", 1, 8)
        assert queue.waiting_ids(8) == ["job-1"]
        assert taken.get_job_ids() == []


def test_an_attempt_that_broke_in_the_worker_comes_back(queue: JobQueue) -> None:
    """The task cannot be found in this process's path of the worker, so RQ calls the attempt failed."""
    broken = Queue(queue_name(8), connection=queue.redis, serializer=JSONSerializer)
    broken.enqueue_call("no_such_module.run", job_id="job-1")
    worker = SimpleWorker([broken], connection=queue.redis, serializer=JSONSerializer)
    worker.work(burst=True, logging_level="CRITICAL")
    assert Job.fetch("job-1", connection=queue.redis, serializer=JSONSerializer).is_failed
    assert not queue.holds("job", 1)
    assert queue.offer("job", 1, 8)


def test_a_redis_that_is_away_is_an_error_at_once() -> None:
    queue = JobQueue(connect_redis(StoreSettings(redis_url="redis://127.0.0.1:1/0")))
    with pytest.raises(redis.RedisError):
        queue.offer("job", 1, 8)


def test_an_attempt_waits_in_one_queue_only(queue: JobQueue) -> None:
    assert queue.offer("job", 1, 8)
    assert not queue.offer("job", 1, 16)
    assert (queue.waiting_ids(8), queue.waiting_ids(16)) == (["job-1"], [])


def test_workers_that_announce_themselves_make_classes(queue: JobQueue) -> None:
    assert queue.classes() == []
    queue.announce("a", class_of((24 << 30) + 1))
    queue.announce("b", 24)
    queue.announce("c", class_of((8 << 30) - 1))
    assert queue.classes() == [WorkerClass(7, 1, 1), WorkerClass(24, 2, 2)]
    queue.announce("b", 24, busy=True)
    assert queue.classes() == [WorkerClass(7, 1, 1), WorkerClass(24, 2, 1)]
    assert 0 < queue.redis.ttl(PRESENCE + "a") <= PRESENCE_SECONDS, "the dead are forgotten"
    queue.depart("a")
    queue.depart("c")
    assert queue.classes() == [WorkerClass(24, 1, 0)]


def test_what_waits_for_a_class_that_is_gone_is_taken_back(queue: JobQueue) -> None:
    queue.offer("a", 1, 8)
    queue.offer("b", 1, 24)
    queue.withdraw({24})
    assert (queue.waiting_ids(8), queue.waiting_ids(24)) == ([], ["b-1"])
    assert queue.offer("a", 1, 24)
    assert queue.waiting_ids(24) == ["b-1", "a-1"]
