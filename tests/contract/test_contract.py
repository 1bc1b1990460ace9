"""The shared words: bounds, defaults, and that they stay light."""

from __future__ import annotations

import subprocess
import sys
from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from advtex_contract.errors import ErrorBody, ErrorCode, ErrorDetail
from advtex_contract.jobs import RETRYABLE, STATES, TERMINAL, JobSpec, JobState, JobView
from advtex_contract.options import PRESET_HELP, JobOptions, Preset, chosen_options
from advtex_options import refusal
from advtex_options.box import Box, parse_box
from advtex_options.methods import METHOD_HELP


def test_every_preset_is_explained() -> None:
    assert set(PRESET_HELP) == set(Preset)


def test_defaults_suit_most_scans() -> None:
    defaults = {"preset": "auto", "max_texture_size": 4096, "seed": 0}
    assert JobOptions().model_dump() == defaults


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("width", 64, 4096),
        ("height", 64, 4096),
        ("steps", 1, 1_000_000),
        ("face_budget", 100, 2_000_000),
        ("max_views", 2, 2_000),
        ("max_texture_size", 256, 16384),
        ("holdout", 2, 1000),
        ("seed", 0, 2**31 - 1),
    ],
)
def test_bounds_of_options(name: str, low: int, high: int) -> None:
    both = {"width": 100, "height": 100} if name in ("width", "height") else {}
    for value in (low, high):
        assert getattr(JobOptions.model_validate(both | {name: value}), name) == value
    for value in (low - 1, high + 1, low + 0.5, "many"):
        with pytest.raises(ValidationError, match=name):
            JobOptions.model_validate(both | {name: value})


@pytest.mark.parametrize(("given", "meant"), [(True, True), ("true", True), ("false", False), (None, None)])
def test_yes_or_no_may_be_written_as_a_column_has_it(given: object, meant: bool | None) -> None:
    assert chosen_options({"lossless": given}).lossless is meant


def test_neither_yes_nor_no_is_refused() -> None:
    with pytest.raises(ValueError, match=r"lossless 'maybe' is neither true nor false; give one of them, or leave it"):
        chosen_options({"lossless": "maybe"})


def test_a_box_is_a_center_a_size_and_a_turn() -> None:
    given = "0, -1.5,1e-1,2,2,2,30"
    assert JobOptions.model_validate({"box": given}).box == given
    assert parse_box(given) == Box((0, -1.5, 0.1), (2, 2, 2), 30)
    assert parse_box("0,0,0,1,2,3") == Box((0, 0, 0), (1, 2, 3), 0)


@pytest.mark.parametrize(
    "given", ["", "0,0,0,1,1", "0,0,0,1,1,0", "0,0,0,1,1,nan", "0,0,0,1,1,1,30,4", "a box", "0 0 0 1 1 1"]
)
def test_what_is_no_box_is_refused_in_the_same_words_everywhere(given: str) -> None:
    words = "is no box; give it as X,Y,Z,SIZE_X,SIZE_Y,SIZE_Z"
    with pytest.raises(ValidationError, match=words):
        JobOptions.model_validate({"box": given})
    with pytest.raises(ValueError, match=words):
        chosen_options({"box": given})
    assert words in str(refusal("box", given))


@pytest.mark.parametrize("side", ["width", "height"])
def test_half_a_size_is_refused(side: str) -> None:
    with pytest.raises(ValidationError, match="width and height go together"):
        JobOptions.model_validate({side: 100})


@pytest.mark.parametrize("options", [{"preset": "fastest"}, {"method": "m" * 41}, {"stpes": 3}])
def test_unknown_options_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(ValidationError, match=next(iter(options))):
        JobOptions.model_validate(options)


@pytest.mark.parametrize("name", ["method", "layout"])
def test_words_that_another_installation_may_know_are_refused_where_they_are_chosen_only(name: str) -> None:
    assert getattr(JobOptions.model_validate({name: "magic"}), name) == "magic"
    with pytest.raises(ValueError, match=f"{name} 'magic' is unknown; choose one of "):
        chosen_options({name: "magic"})


def test_known_methods_are_offered() -> None:
    known, another, none = JobOptions.model_json_schema()["properties"]["method"]["anyOf"]
    assert known["enum"] == list(METHOD_HELP)
    assert another == {"type": "string", "maxLength": 40}
    assert none == {"type": "null"}


@given(st.text(max_size=250))
def test_labels_are_one_printable_line(label: str) -> None:
    bad = len(label) > 200 or any(ord(c) < 32 or ord(c) == 127 for c in label)
    try:
        assert JobSpec(upload_id="a", label=label).label == label
    except ValidationError:
        assert bad
    else:
        assert not bad


def test_the_table_has_all_states_and_their_ends() -> None:
    assert list(STATES) == list(JobState), "in the order in which the page lists them"
    assert set(JobState) - TERMINAL == {JobState.checking, JobState.queued, JobState.running, JobState.preempted}
    assert {JobState.failed, JobState.canceled} == RETRYABLE
    assert {state for state in STATES if not STATES[state].becomes} == TERMINAL - RETRYABLE
    for state, facts in STATES.items():
        assert facts.becomes <= set(JobState) - {state}
        assert f"`{state}` {facts.meaning}" in (JobState.__doc__ or "")


def test_a_job_survives_the_wire() -> None:
    now = datetime.now(UTC)
    job = JobView(
        id="a", state=JobState.queued, upload_id="b", options=JobOptions(seed=7), created_at=now, updated_at=now
    )
    assert JobView.model_validate_json(job.model_dump_json()) == job
    assert None not in job.model_dump()["options"].values(), "an older reader refuses names that it does not know"
    assert job.model_dump(mode="json")["state"] == "queued"


def test_errors_survive_the_wire() -> None:
    body = ErrorBody(
        code=ErrorCode.invalid_scan, message="no", details=[ErrorDetail(where="mesh.ply", message="empty")]
    )
    assert ErrorBody.model_validate_json(body.model_dump_json()) == body
    assert all(code.value == code.name for code in ErrorCode)
    with pytest.raises(ValidationError):
        ErrorBody.model_validate({"code": "unheard_of", "message": "x"})


def test_the_contract_is_light() -> None:
    script = (
        "import sys, advtex_contract.jobs, advtex_contract.errors, advtex_contract.options;"
        "print([m for m in ('httpx', 'redis', 'numpy', 'torch', 'fastapi', 'sqlalchemy') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_a_deadline_that_is_not_given_is_not_written() -> None:
    """A server from before deadlines refuses a name that it does not know; the rest is written as it always was."""
    spec = JobSpec(upload_id="u")
    assert "deadline" not in spec.model_dump(mode="json")
    assert '"source":null' in spec.model_dump_json()
    due = JobSpec(upload_id="u", deadline=datetime(2026, 1, 31, 8, tzinfo=UTC))
    assert JobSpec.model_validate_json(due.model_dump_json()) == due
