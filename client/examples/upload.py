"""Send a scan from an app without the SDK: a resumable upload (tus 1.0.0), a job, its events, and the model.

    python upload.py SCAN.zip MODEL.glb        with ADVTEX_URL and ADVTEX_API_KEY in the environment

Needs httpx alone. Run it again after a broken line: the upload goes on, and the job is the same one.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import httpx

PIECE = 16 << 20
"""Bytes per request: after each, the server has them for good."""
ENDED = {"succeeded", "failed", "canceled", "rejected"}


def upload(http: httpx.Client, scan: Path) -> str:
    """-> the id of the finished upload; what the server has of the same bytes is not sent again"""
    with scan.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        size = file.tell()
    held = answered(http.get("/v1/uploads", params={"sha256": sha256})).json()["uploads"]
    if held:
        address = f"/v1/uploads/{held[0]['id']}"
    else:
        told = {"filename": scan.name, "sha256": sha256}
        metadata = ",".join(f"{name} {base64.b64encode(value.encode()).decode()}" for name, value in told.items())
        headers = {"Upload-Length": str(size), "Upload-Metadata": metadata}
        address = answered(http.post("/v1/uploads", headers=headers)).headers["Location"]
    with scan.open("rb") as file:
        for pause in (1, 2, 4, 8, 16, 0):
            try:
                offset = int(answered(http.head(address)).headers["Upload-Offset"])
                while offset < size:
                    file.seek(offset)
                    headers = {"Upload-Offset": str(offset), "Content-Type": "application/offset+octet-stream"}
                    sent = answered(http.patch(address, content=file.read(PIECE), headers=headers))
                    offset = int(sent.headers["Upload-Offset"])
                return address.rpartition("/")[2]
            except httpx.TransportError as error:  # the server knows how far it came
                print(f"{error}; trying again in {pause} s", file=sys.stderr)
                time.sleep(pause)
    raise SystemExit("the line stays broken; run this again to go on")


def events(http: httpx.Client, job: str) -> Iterator[dict[str, object]]:
    """The job whenever it has changed, until it has ended; server-sent events."""
    while True:
        try:
            with http.stream("GET", f"/v1/jobs/{job}/events", timeout=60) as stream:
                kind = ""
                for line in stream.iter_lines():
                    name, _, value = line.partition(": ")
                    if name == "event":
                        kind = value
                    elif name == "data" and kind == "job":
                        view = json.loads(value)
                        yield view
                        if view["state"] in ENDED:
                            return
        except httpx.TransportError:
            time.sleep(2)


def answered(response: httpx.Response) -> httpx.Response:
    """Every refusal has a body that says what is wrong, and where its code is explained."""
    if response.is_error:
        response.read()
        told = response.json() if response.content else {"message": f"HTTP {response.status_code}", "help": ""}
        raise SystemExit(f"{told['message']} ({response.url.join(told['help'])})")
    return response


def main(scan: Path, model: Path) -> None:
    headers = {"Authorization": f"Bearer {os.environ['ADVTEX_API_KEY']}", "Tus-Resumable": "1.0.0"}
    with httpx.Client(base_url=os.environ["ADVTEX_URL"], headers=headers, timeout=60) as http:
        body = {"upload_id": upload(http, scan), "options": {"preset": "auto"}, "label": scan.stem}
        # The same key and body are the same job, however often this is sent.
        once = hashlib.sha256(json.dumps(body).encode()).hexdigest()
        job = answered(http.post("/v1/jobs", json=body, headers={"Idempotency-Key": once})).json()
        for view in events(http, job["id"]):
            print(view["state"], view["progress"]["stage"], view["progress"]["step"])
            job = view
        if job["state"] != "succeeded":
            raise SystemExit(f"{job['state']}: {(job['error'] or {}).get('message', '')}")
        with http.stream("GET", f"/v1/jobs/{job['id']}/results/model.glb") as bytes_of_it, model.open("wb") as file:
            for chunk in answered(bytes_of_it).iter_bytes():
                file.write(chunk)
    print(model)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
