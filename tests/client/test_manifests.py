"""What a batch consists of: folders, CSV, JSON lines; every mistake is named with its line."""

from __future__ import annotations

import contextlib
import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from advtex_client import ClientError
from advtex_client.manifests import read_items, read_options
from advtex_contract.options import JobOptions, Preset, chosen_options

QUICK = JobOptions(preset=Preset.preview, seed=3)


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    root = tmp_path / "scenes"
    for name in ("scene0000_01", "scene0000_00", ".hidden"):
        (root / name).mkdir(parents=True)
    (root / "packed.zip").touch()
    (root / "notes.txt").touch()
    return root


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_a_folder_holds_scans(scenes: Path) -> None:
    items = read_items(scenes, QUICK, priority=5)
    assert [(item.path, item.source, item.label) for item in items] == [
        (scenes / "packed.zip", None, "packed.zip"),
        (scenes / "scene0000_00", None, "scene0000_00"),
        (scenes / "scene0000_01", None, "scene0000_01"),
    ]
    assert {(item.options, item.priority) for item in items} == {(QUICK, 5)}
    referred = read_items(scenes, QUICK, by_reference=True)
    assert [(item.path, item.source) for item in referred][1] == (None, (scenes / "scene0000_00").as_uri())


def test_csv(scenes: Path) -> None:
    text = (
        "\ufeffpath,label,options,priority,keep_days\n"
        'scene0000_00,"kitchen, north","{""steps"": 7, ""preset"": ""full""}",-3,0.5\n'
        "\n"
        "s3://scans/a b.zip,,,,\n"
    )
    local, referred = read_items(write(scenes, "list.csv", text), QUICK, priority=1, retention=86400)
    assert (local.retention_seconds, referred.retention_seconds) == (43200, 86400)
    assert (local.path, local.label, local.priority) == (scenes / "scene0000_00", "kitchen, north", -3)
    assert local.options == JobOptions(preset=Preset.full, steps=7, seed=3)
    assert (referred.path, referred.source, referred.label) == (None, "s3://scans/a b.zip", "a b.zip")
    assert (referred.options, referred.priority) == (QUICK, 1)


def test_each_option_may_have_a_column(scenes: Path) -> None:
    text = "path,size,steps,options\nscene0000_00,320x240,7,\nscene0000_01,,,{}\n"
    first, second = read_items(write(scenes, "list.csv", text), QUICK)
    assert first.options == QUICK.model_copy(update={"width": 320, "height": 240, "steps": 7})
    assert second.options == QUICK


def test_deadlines(scenes: Path) -> None:
    usual = datetime(2026, 2, 1, 8, tzinfo=UTC)
    text = "path,deadline\nscene0000_00,2026-01-31T08:00+02:00\nscene0000_01,\npacked.zip,2026-01-31T08:00\n"
    first, second, third = read_items(write(scenes, "list.csv", text), QUICK, deadline=usual)
    assert first.deadline == datetime(2026, 1, 31, 6, tzinfo=UTC)
    assert second.deadline == usual
    assert third.deadline == datetime(2026, 1, 31, 8).astimezone(), "of this computer's time zone"
    assert len({first.identity, replace(first, deadline=None).identity, replace(first, deadline=usual).identity}) == 3


def test_the_root_of_scannet(tmp_path: Path) -> None:
    for name in ("scene0000_01", "scene0000_00", "scene0707_00", "notes"):
        (tmp_path / "scans" / name).mkdir(parents=True)
    (tmp_path / "scans" / "scene0001_00").touch()
    (tmp_path / "scans_test").mkdir()
    items = read_items(tmp_path, QUICK)
    assert [item.label for item in items] == ["scene0000_00", "scene0000_01", "scene0707_00"]
    assert items[0].path == tmp_path / "scans" / "scene0000_00"
    (item,) = read_items(write(tmp_path / "scans", "list.csv", "path\nscene0000_00\n"), QUICK)
    assert item.identity == items[0].identity, "a manifest names the same scan"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("night.toml", 'preset = "full"\nsize = "320x240"\nholdout = 8\n'),
        ("night.json", '{"preset": "full", "size": "320x240", "holdout": 8}'),
    ],
)
def test_a_file_of_options(tmp_path: Path, name: str, text: str) -> None:
    options = chosen_options(read_options(write(tmp_path, name, text)))
    assert options == JobOptions(preset=Preset.full, width=320, height=240, holdout=8)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("night.toml", "preset = full\n", "night.toml cannot be read"),
        ("night.json", "[1]", "night.json is no JSON object"),
        ("night.json", '{"prseet": "full"}', "night.json: there is no option 'prseet'; the options are preset"),
        ("night.toml", "\xff", "night.toml cannot be read"),
    ],
)
def test_a_mistake_in_a_file_of_options_is_named(tmp_path: Path, name: str, text: str, message: str) -> None:
    with pytest.raises(ClientError) as caught:
        read_options(write(tmp_path, name, text))
    assert message in str(caught.value)
    with pytest.raises(ClientError, match=r"none\.toml cannot be read"):
        read_options(tmp_path / "none.toml")


def test_json_lines(scenes: Path) -> None:
    rows = [{"path": "scene0000_00", "options": {"steps": 7}}, {"path": "file:///data/x/", "priority": 9}]
    text = "\n".join(map(json.dumps, rows)) + "\n\n"
    local, referred = read_items(write(scenes, "list.jsonl", text), QUICK)
    assert (local.path, local.options.steps) == (scenes / "scene0000_00", 7)
    assert (referred.source, referred.label, referred.priority) == ("file:///data/x/", "x", 9)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "path\nx\nx\n", "line 3 is the same as a.csv line 2"),
        ("a.csv", "path,stpes\nx,3\n", "line 2: there is no column 'stpes'"),
        ("a.csv", "path,size\nx,8x8\n", "line 2: size 8x8 is out of bounds"),
        ("a.csv", "label\nx\n", "line 2: the path is missing"),
        ("a.csv", 'path,options\nx,"{""steps"": 0}"\n', "line 2: steps 0 is out of bounds; give 1 to 1000000"),
        ("a.csv", "path,options\nx,fast\n", "line 2: options must be a JSON object"),
        ("a.csv", "path,options\nx,3\n", "line 2: options must be a JSON object"),
        ("a.csv", "path,priority\nx,high\n", "priority and keep_days numbers"),
        ("a.jsonl", '{"path": "x", "priority": Infinity}\n', "priority and keep_days numbers"),
        ("a.csv", "path,keep_days\nx,long\n", "priority and keep_days numbers"),
        ("a.csv", "path,deadline\nx,soon\n", "keep_days numbers: Invalid isoformat string: 'soon'"),
        ("a.jsonl", '{"path": "x", "deadline": 3}\n', "deadline an ISO time"),
        (
            "a.csv",
            "path,keep_days\nx,-1\n",
            "priority and keep_days numbers: -1",
        ),
        ("a.jsonl", '{"path": "x", "keep_days": NaN}\n', "nan is no number of days"),
        ("a.csv", "path\nx,y,z\n", "line 2: there is no column"),
        ("a.csv", 'path\n"x\n', "cannot be read"),
        ("a.csv", "path\n", "holds no scans"),
        ("a.jsonl", "{}\n", "line 1: the path is missing"),
        ("a.jsonl", '\n{"path": 3}\n', "line 2: the path is missing"),
        ("a.jsonl", "[1]\n", "line 1 is no JSON object"),
        ("a.jsonl", '{"path": "x"\n', "line 1 is no JSON"),
        ("a.jsonl", '{"path": "x", "options": [1]}\n', "options must be a JSON object"),
    ],
)
def test_a_mistake_is_named_with_its_line(tmp_path: Path, name: str, text: str, message: str) -> None:
    with pytest.raises(ClientError) as caught:
        read_items(write(tmp_path, name, text), QUICK)
    assert message in str(caught.value)


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "latin.csv").write_bytes(b"path\n\xff\xfe\n")
    for name in ("latin.csv", "none.csv"):
        with pytest.raises(ClientError, match=name):
            read_items(tmp_path / name, QUICK)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ClientError, match="holds no scans"):
        read_items(tmp_path / "empty", QUICK)


values = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=10) | st.lists(st.integers())
rows = st.dictionaries(
    st.sampled_from(["path", "label", "options", "priority", "keep_days", "deadline"]) | st.text(max_size=5),
    values | st.dictionaries(st.sampled_from(["steps", "preset", "x"]), values, max_size=2),
    max_size=4,
)


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.one_of(rows.map(json.dumps), st.text(max_size=40)), max_size=4), st.sampled_from(["csv", "jsonl"]))
def test_whatever_a_manifest_holds_there_are_items_or_one_error(tmp_path: Path, lines: Any, suffix: str) -> None:
    path = tmp_path / f"any.{suffix}"
    path.write_bytes("\n".join(lines).encode("utf-8", errors="surrogatepass"))
    with contextlib.suppress(ClientError):
        assert read_items(path, QUICK)
