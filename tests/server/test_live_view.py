"""The live view of a job over HTTP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from advtex_contract.live import Curves, LivePicture, LiveRecord


def test_a_running_job_shows_its_newest_look(live: Any, scan_zip: Path, is_error: Any) -> None:
    job = live.job(live.upload(scan_zip.read_bytes()))["id"]
    url = f"/v1/jobs/{job}/live"
    nothing = {"step": 0, "curves": {"steps": [], "series": {}, "quality": {"steps": [], "series": {}}}, "images": []}
    assert live.http.get(url).json() == nothing
    live.store.records.claim(job, 1, "w")
    curves = Curves(steps=[1, 7], series={"l1": [0.5, None]})
    for step in (3, 7):
        pictures = [LivePicture(name="0.jpg", view="<b>.png", jpeg=b"\xff\xd8 %d" % step)]
        live.store.live.write(job, 1, LiveRecord(step=step, curves=curves, pictures=pictures))
    view = live.http.get(url).json()
    assert (view["step"], view["curves"]) == (7, curves.model_dump())
    (image,) = view["images"]
    assert (image["name"], image["view"]) == ("0.jpg", "<b>.png")
    answer = live.http.get(image["href"])
    assert (answer.status_code, answer.content) == (200, b"\xff\xd8 7")
    assert answer.headers["content-type"] == "image/jpeg"
    assert answer.headers["x-content-type-options"] == "nosniff"
    is_error(live.http.get(f"{url}/1.jpg"), 404, "not_found")
    with live.client(live.store.accounts.create_key("other", owner="you")) as stranger:
        is_error(stranger.get(url), 404, "not_found")
        is_error(stranger.get(image["href"]), 404, "not_found")
    live.store.records.lost(job, 1)
    assert live.http.get(url).json()["step"] == 7, "until the next attempt has something to show"
    live.store.records.claim(job, 2, "w")
    live.store.live.write(job, 2, LiveRecord(step=1, curves=curves, pictures=[]))
    live.store.live.write(job, 1, LiveRecord(step=99, curves=curves, pictures=[]))  # an attempt that lost the job
    assert live.http.get(url).json()["step"] == 1
    live.store.live.write(job, 2, LiveRecord(step=2, curves=curves, pictures=[]))
    live.store.blobs.put(f"jobs/{job}/live/2.json", b'{"of": "another version"}')
    live.store.blobs.delete(f"jobs/{job}/live/1.json")
    assert live.http.get(url).json() == nothing


def test_a_job_that_never_began_shows_nothing(live: Any) -> None:
    """A rejected one has no attempt at all."""
    job = live.job(live.upload(b"no scan"))
    assert job["state"] == "rejected"
    answer = live.http.get(f"/v1/jobs/{job['id']}/live")
    assert (answer.status_code, answer.json()["images"]) == (200, [])
    assert live.http.get(f"/v1/jobs/{job['id']}/live/0.jpg").status_code == 404
