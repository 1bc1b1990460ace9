"""A worker that loses Redis begins anew with another connection, and leaves nothing of the old one behind."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import redis.exceptions

from advtex_store.queue import connect_redis
from advtex_worker.leaving import Departure, Stay
from advtex_worker.main import JobWorker
from advtex_worker.tasks import Host


def assert_its_listener_ends(worker: JobWorker, lose: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
    """When `lose` is what becomes of its first wait for a job."""
    monkeypatch.setattr(worker, "dequeue_job_and_maintain_ttl", lose)
    monkeypatch.setattr(worker, "_install_signal_handlers", lambda: None)
    with pytest.raises(redis.exceptions.RedisError):
        worker.work(logging_level="WARNING")
    listener = worker.pubsub_thread
    assert listener is not None
    listener.join(10)
    assert not listener.is_alive()


def test_what_listened_to_a_redis_that_is_gone_ends(
    host: Callable[[str], Host], own_redis: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = host("quick").settings.model_copy(update={"redis_url": own_redis.url})
    connection = connect_redis(settings)
    worker = JobWorker(Host(settings), connection, Departure(Stay(), 1.0), 8)

    def lose(*_: object) -> None:
        own_redis.stop()
        raise redis.exceptions.TimeoutError("silence")

    assert_its_listener_ends(worker, lose, monkeypatch)


@pytest.mark.one_machine("what threads of one process do to each other")
def test_who_listens_ends_without_a_word_when_its_connection_is_closed(
    host: Callable[[str], Host], redis_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = host("quick").settings.model_copy(update={"redis_url": redis_url})
    worker = JobWorker(Host(settings), connect_redis(settings), Departure(Stay(), 1.0), 8)

    def lose(*_: object) -> None:
        raise redis.exceptions.TimeoutError("silence")

    monkeypatch.setattr("rq.Worker.register_death", lose)
    assert_its_listener_ends(worker, lose, monkeypatch)
