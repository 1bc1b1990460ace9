"""JSON files that may hold anything: values of the wanted kind, or None."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from advtex_scan.errors import ScanFormatError
from advtex_scan.layouts._reader import ScanReader

JSON_LIMIT = 16 << 20


def json_object(reader: ScanReader, name: str, remedy: str = "export it again") -> Mapping[str, Any] | None:
    """Return the object in a JSON file; None, with a finding and its remedy, if there is none."""
    reader.used.add(name)
    try:
        value = json.loads(reader.archive.read(name, JSON_LIMIT))
    except ScanFormatError as error:
        reader.findings.extend(error.findings)
        return None
    except (ValueError, RecursionError) as error:
        reader.findings.error("bad_json", name, f"is not valid JSON ({error})", remedy)
        return None
    if not isinstance(value, dict):
        reader.findings.error("bad_json", name, "does not hold a JSON object", remedy)
        return None
    return value


def json_number(value: Any) -> float | None:
    """Return a JSON number as a float; None for anything else, integers beyond the floats included."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None
    try:
        return float(value)
    except OverflowError:
        return None


def json_numbers(value: Any, count: int) -> list[float] | None:
    """Return `count` numbers from a list; None for anything else."""
    if not isinstance(value, list) or len(value) != count:
        return None
    numbers = [json_number(entry) for entry in value]
    return None if None in numbers else [number for number in numbers if number is not None]


def json_size(width: Any, height: Any) -> tuple[int, int] | None:
    """Return an image size; None unless both are positive whole numbers of at most six digits."""
    numbers = [json_number(width), json_number(height)]
    if not all(number is not None and number.is_integer() and 0 < number < 10**6 for number in numbers):
        return None
    return int(width), int(height)
