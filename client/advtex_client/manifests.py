"""What a batch consists of: a folder of scans, or a manifest (CSV or JSON lines) that lists them.

path       a scan's folder, zip or .sens, relative to the manifest, or its file:// or s3:// URL on the server's side
label      the job's name; the last part of the path if it is left out
options    a JSON object of options that differ from those of the command
preset, method, size, steps ...  each option may have a column of its own too
priority   larger runs earlier
keep_days  how long the job is kept after its end
deadline   by when it is to have ended: an ISO time, of this computer's time zone where it states none
"""

from __future__ import annotations

import csv
import json
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from advtex_client.errors import ClientError
from advtex_contract.options import JobOptions, chosen_options
from advtex_options import described

COLUMNS = ("path", "label", "options", "priority", "keep_days", "deadline", *described())
FILES = (".zip", ".r3d", ".sens")  # Record3D's files are zips
SCHEMES = ("file://", "s3://")
SCANNET_SCENES = "scene[0-9][0-9][0-9][0-9]_[0-9][0-9]"


@dataclass(frozen=True)
class BatchItem:
    """One job to be: `path` is a scan on this computer, `source` the URL of one that the server can read."""

    path: Path | None
    source: str | None
    label: str
    options: JobOptions
    priority: int = 0
    retention_seconds: int | None = None
    deadline: datetime | None = None

    @property
    def identity(self) -> tuple[str, ...]:
        """What makes it the same item in a later run."""
        kept = () if self.retention_seconds is None else (f"kept {self.retention_seconds}",)
        due = () if self.deadline is None else (f"due {self.deadline.timestamp()}",)
        given = self.label, self.options.model_dump_json(), str(self.priority)
        return self.source or str(self.path), *given, *kept, *due


def retention_seconds(days: float) -> int:
    """Return whole seconds. Raises ValueError for what is no time."""
    if not 0 < days < 1e6:
        raise ValueError(f"{days:g} is no number of days that a job could be kept")
    return round(days * 86400)


def deadline_of(text: str) -> datetime:
    """Return the time that an ISO text says, of this computer's time zone if it states none. Raises ValueError."""
    return datetime.fromisoformat(text).astimezone()


def read_options(path: Path) -> dict[str, Any]:
    """Read options by name from a .toml or .json file, as `chosen_options` takes them. Raises ClientError."""
    try:
        text = path.read_text(encoding="utf-8")
        given = tomllib.loads(text) if path.suffix.lower() == ".toml" else json.loads(text)
    except (OSError, ValueError) as error:
        raise ClientError(f"{path} cannot be read: {error}; give a .toml or .json file of options") from error
    if not isinstance(given, dict):
        raise ClientError(f'{path} is no JSON object; write {{"preset": "standard", "size": "640x480"}}')
    if unknown := [name for name in given if name not in described()]:
        raise ClientError(f"{path}: there is no option {unknown[0]!r}; the options are {', '.join(described())}")
    return given


def read_items(
    place: Path,
    options: JobOptions,
    priority: int = 0,
    by_reference: bool = False,
    retention: int | None = None,
    deadline: datetime | None = None,
) -> list[BatchItem]:
    """Read the scans of a folder (each folder, zip and .sens in it; of ScanNet's root those in `scans`) or of a
    manifest. Raises ClientError, with the line.

    by_reference: the server reads them at the same path; nothing is sent.
    options, priority, retention (seconds), deadline: of those that say nothing else.
    """
    found: list[tuple[str, Mapping[str, Any]]]
    try:
        if place.is_dir():
            found = [(f"{place.name}/{name}", {"path": name}) for name in _scans(place)]
            base = place
        else:
            found = [(f"{place.name} line {number}", row) for number, row in _rows(place)]
            base = place.parent
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        remedy = "give a folder of scans, a .csv or a .jsonl file"
        raise ClientError(f"{place} cannot be read: {error}; {remedy}") from error
    usual = BatchItem(None, None, "", options, priority, retention, deadline)
    items = [_item(where, row, base, usual, by_reference) for where, row in found]
    if not items:
        raise ClientError(f"{place} holds no scans; give the folder that holds their folders or zips, or a manifest")
    seen: dict[tuple[str, ...], str] = {}
    for (where, _), item in zip(found, items, strict=True):
        if item.identity in seen:
            raise ClientError(f"{where} is the same as {seen[item.identity]}; remove one, or give them labels")
        seen[item.identity] = where
    return items


def _scans(folder: Path) -> list[str]:
    scenes = folder.joinpath("scans").glob(SCANNET_SCENES)
    if root := sorted(f"scans/{path.name}" for path in scenes if path.is_dir()):
        return root
    paths = (path for path in folder.iterdir() if not path.name.startswith("."))
    return sorted(path.name for path in paths if path.is_dir() or path.suffix.lower() in FILES)


def _rows(manifest: Path) -> Iterator[tuple[int, Mapping[str, Any]]]:
    with manifest.open(encoding="utf-8-sig", newline="") as file:
        if manifest.suffix.lower() == ".csv":
            reader = csv.DictReader(file, strict=True)
            for row in reader:
                yield reader.line_num, {name: value for name, value in row.items() if value not in (None, "")}
            return
        for number, line in enumerate(file, 1):
            if not line.strip():
                continue
            try:
                parsed = json.loads(line)
            except ValueError as error:
                raise ClientError(f"{manifest.name} line {number} is no JSON: {error}") from error
            if not isinstance(parsed, dict):
                raise ClientError(f"{manifest.name} line {number} is no JSON object")
            yield number, parsed


def _item(where: str, row: Mapping[str, Any], base: Path, usual: BatchItem, by_reference: bool) -> BatchItem:
    if unknown := [str(name) for name in row if name not in COLUMNS]:
        raise ClientError(f"{where}: there is no column {unknown[0]!r}; the columns are {', '.join(COLUMNS)}")
    name, label = row.get("path"), row.get("label")
    if not isinstance(name, str) or not name:
        raise ClientError(f"{where}: the path is missing")
    if label is None:
        label = name.rstrip("/").rpartition("/")[2]
    try:
        given = row.get("options", {})
        given = json.loads(given) if isinstance(given, str) else given
        if not isinstance(given, dict):
            raise TypeError(f"{given!r} is no JSON object")
        given = given | {name: row[name] for name in described() if name in row}
        wanted = int(row.get("priority", usual.priority))
        kept = retention_seconds(float(row["keep_days"])) if "keep_days" in row else usual.retention_seconds
        due = deadline_of(row["deadline"]) if "deadline" in row else usual.deadline
    except (ValueError, TypeError, OverflowError) as error:
        kinds = "options must be a JSON object, deadline an ISO time, priority and keep_days numbers"
        raise ClientError(f"{where}: {kinds}: {error}") from error
    try:
        merged = chosen_options(given, usual.options)
    except ValueError as error:
        raise ClientError(f"{where}: {error}") from error
    item = replace(usual, label=str(label), options=merged, priority=wanted, retention_seconds=kept, deadline=due)
    if name.startswith(SCHEMES):
        return replace(item, source=name)
    path = (base / name).absolute()
    return replace(item, source=path.as_uri()) if by_reference else replace(item, path=path)
