"""Names of all blobs, in one place.

    scans/{upload}/scan.zip
    jobs/{job}/checkpoints/{attempt}/...      stage caches and checkpoint of one attempt
    jobs/{job}/live/{attempt}.json            what the texture looks like while the attempt makes it
    jobs/{job}/results/{attempt}/...          files that one attempt made
    jobs/{job}/result.json                    the manifest: written last, once, by the attempt that won

A resuming attempt lays the checkpoints of all earlier attempts over one another, oldest first: later files replace
earlier ones of the same name. An attempt writes below its own number only, so one that lost its lease harms nothing.
"""

from __future__ import annotations

SCANS = "scans/"
JOBS = "jobs/"


def scan_key(upload_id: str) -> str:
    return f"scans/{upload_id}/scan.zip"


def scan_prefix(upload_id: str) -> str:
    return f"scans/{upload_id}/"


def job_prefix(job_id: str) -> str:
    return f"jobs/{job_id}/"


def checkpoints_prefix(job_id: str) -> str:
    """Of all attempts; the next path segment is the attempt's number."""
    return f"jobs/{job_id}/checkpoints/"


def checkpoint_prefix(job_id: str, attempt: int) -> str:
    return f"jobs/{job_id}/checkpoints/{attempt}/"


def live_prefix(job_id: str) -> str:
    """Of all attempts."""
    return f"jobs/{job_id}/live/"


def live_key(job_id: str, attempt: int) -> str:
    return f"jobs/{job_id}/live/{attempt}.json"


def results_prefix(job_id: str) -> str:
    """Of all attempts."""
    return f"jobs/{job_id}/results/"


def result_key(job_id: str, attempt: int, name: str) -> str:
    return f"jobs/{job_id}/results/{attempt}/{name}"


def result_manifest_key(job_id: str) -> str:
    return f"jobs/{job_id}/result.json"
