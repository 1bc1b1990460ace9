"""Attempts carried in the test's own process, and what they leave behind."""

from __future__ import annotations

import threading

from advtex_store.store import Store
from advtex_worker.tasks import Host, run_attempt


def in_background(host: Host, job_id: str, attempt: int = 1) -> threading.Thread:
    thread = threading.Thread(target=run_attempt, args=(host, job_id, attempt))
    thread.start()
    return thread


def step_of(store: Store, job_id: str) -> int:
    return int(store.records.job(job_id).progress["step"])


def result(store: Store, job_id: str, name: str = "model.obj") -> str:
    manifest = store.results.manifest(job_id)
    (file,) = [file for file in manifest.files if file.name == name]
    return store.blobs.get(file.key).decode()


def spent(store: Store, job_id: str) -> float:
    return float(sum(store.records.job(job_id).progress["stage_seconds"].values()))
