"""Names of all blobs, in one place.

    scans/{upload}/scan.zip
    jobs/{job}/checkpoints/{attempt}/...      files of one attempt's checkpoints, and the index of its newest one
    jobs/{job}/live/{attempt}.json            what the texture looks like while the attempt makes it
    jobs/{job}/results/{attempt}/...          files that one attempt made
    jobs/{job}/result.json                    the manifest: written last, once, by the attempt that won

The newest attempt that has an index has the job's checkpoint; its index names files of earlier attempts too, where they
have not changed since. An attempt writes below its own number only, so one that lost its lease harms nothing.
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
    """What the checkpoints of all attempts lie below; the next path segment is the attempt's number."""
    return f"jobs/{job_id}/checkpoints/"


def checkpoint_prefix(job_id: str, attempt: int) -> str:
    return f"jobs/{job_id}/checkpoints/{attempt}/"


def live_prefix(job_id: str) -> str:
    """What all attempts show lies below it."""
    return f"jobs/{job_id}/live/"


def live_key(job_id: str, attempt: int) -> str:
    return f"jobs/{job_id}/live/{attempt}.json"


def results_prefix(job_id: str) -> str:
    """What the results of all attempts lie below."""
    return f"jobs/{job_id}/results/"


def result_key(job_id: str, attempt: int, name: str) -> str:
    return f"jobs/{job_id}/results/{attempt}/{name}"


def result_manifest_key(job_id: str) -> str:
    return f"jobs/{job_id}/result.json"
