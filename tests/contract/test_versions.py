"""Older and newer versions read each other: what is told and stored is open, what is sent is not."""

from __future__ import annotations

import inspect
import json
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

from advtex_contract import errors, health, jobs, live, options, stored_options, webhooks
from advtex_options.outputs import OUTPUTS, wanted

SENT = {jobs.BatchLimits, jobs.JobSpec, options.JobOptions, webhooks.WebhookSpec}
MODELS = sorted(
    {
        model
        for module in (errors, health, jobs, live, options, stored_options, webhooks)
        for _, model in inspect.getmembers(module, inspect.isclass)
        if issubclass(model, BaseModel) and model.__module__ == module.__name__ and not model.__name__.startswith("_")
    },
    key=lambda model: model.__name__,
)
JOB: dict[str, Any] = {
    "id": "a",
    "state": "queued",
    "upload_id": "u",
    "options": {"preset": "paper", "from_the_future": 1},
    "progress": {"stage": "atlas", "from_the_future": 1},
    "warnings": [{"message": "m", "from_the_future": 1}],
    "error": {"code": "c", "message": "m", "from_the_future": 1},
    "results": [],
    "created_at": "2026-01-01T00:00:00Z",
    "updated_at": "2026-01-01T00:00:00Z",
    "from_the_future": 1,
}


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_what_is_sent_is_closed_and_all_else_is_open(model: type[BaseModel]) -> None:
    assert (model.model_config.get("extra") == "forbid") == (model in SENT)


def test_a_job_of_a_newer_version_is_read() -> None:
    view = jobs.JobView.model_validate(JOB)
    assert view.options == options.JobOptions(preset=options.Preset.paper)
    assert view.progress.stage == "atlas"
    assert view.error is not None
    assert view.error.code == "c"


def test_a_job_in_a_state_that_only_a_newer_version_knows_goes_on() -> None:
    view = jobs.JobView.model_validate(JOB | {"state": "from_the_future"})
    assert view.state == "from_the_future"
    assert view.state not in jobs.TERMINAL
    assert jobs.JobView.model_validate_json(view.model_dump_json()) == view
    assert jobs.JobView.model_validate(JOB).state is jobs.JobState.queued
    batch = {"id": "b", "jobs": 2, "states": {"from_the_future": 1, "queued": 1}, "finished": False}
    times = {key: JOB[key] for key in ("created_at", "updated_at")}
    read = jobs.BatchView.model_validate_json(json.dumps(batch | times))
    assert read.states == {"from_the_future": 1, jobs.JobState.queued: 1}


def test_a_job_of_an_older_version_is_read() -> None:
    least = {key: JOB[key] for key in ("id", "state", "upload_id", "created_at", "updated_at")}
    view = jobs.JobView.model_validate(least | {"options": {}, "progress": {}})
    assert view.options == options.JobOptions()
    assert view.progress == jobs.Progress()


ODD = st.sampled_from([None, True, -1, 1 << 40, 0.5, "", "ultra", [1], {"a": 1}])


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.dictionaries(st.sampled_from([*options.JobOptions.model_fields, "from_the_future"]), ODD))
def test_options_of_any_version_are_read_as_they_are_and_sent_by_none_but_their_own(stored: dict[str, Any]) -> None:
    view = jobs.JobView.model_validate(JOB | {"options": stored})
    assert jobs.JobView.model_validate_json(view.model_dump_json()) == view
    for name, value in options.known_options(stored).items():
        assert getattr(view.options, name) == value
    if options.misunderstood(stored) is None:
        assert isinstance(view.options, options.JobOptions)
    elif {"layout", "method", "from_the_future"}.isdisjoint(stored):  # the first two are open words
        with pytest.raises(ValidationError):
            jobs.JobSpec.model_validate({"upload_id": "u", "options": stored})


def test_an_option_that_only_another_version_knows_does_no_harm_until_it_is_given() -> None:
    stored = options.JobOptions().model_dump(mode="json") | {"from_the_future": None}
    assert options.misunderstood(stored) is None
    assert "from_the_future" in (options.misunderstood(stored | {"from_the_future": 0}) or "")


def test_options_that_are_sent_are_refused_where_they_are_not_known() -> None:
    with pytest.raises(ValidationError, match="from_the_future"):
        jobs.JobSpec.model_validate({"upload_id": "u", "options": {"from_the_future": 1}})


def test_which_files_are_made_is_a_list_of_known_words() -> None:
    assert options.chosen_options({"outputs": "usdz,mobile"}).outputs == "usdz,mobile"
    for wrong in ("fbx", "usdz,fbx", "usdz, mobile", ""):
        with pytest.raises(
            ValueError, match=r"outputs .* is unknown; choose one of obj, glb, usdz, mobile, lod, tiles"
        ):
            options.chosen_options({"outputs": wrong})
        with pytest.raises(ValidationError, match="choose one of obj"):
            jobs.JobSpec.model_validate({"upload_id": "u", "options": {"outputs": wrong}})


def test_what_a_file_is_for_may_be_untold() -> None:
    least = {"name": "model.glb", "size": 1, "sha256": "0" * 64, "content_type": "x", "url": "/"}
    assert jobs.ResultFile.model_validate(least).purpose == ""
    assert jobs.ResultFile.model_validate(least | {"kind": "glb", "from_the_future": 1}).kind == "glb"


def test_what_was_not_asked_for_is_left_out_but_for_what_is_always_made() -> None:
    assert wanted(None) == set(OUTPUTS) - {"tiles", "draco", "webp"}
    assert wanted(None, large=True) == set(OUTPUTS) - {"draco", "webp"}
    assert wanted("tiles") == {"obj", "glb", "tiles"}
    assert wanted("webp", large=True) == {"obj", "glb", "webp"}
    assert wanted("mobile") == {"obj", "glb", "mobile"}
    assert wanted("glb") == {"obj", "glb"}
