"""Byte ranges (RFC 9110, section 14)."""

from __future__ import annotations

import re

from advtex_contract.errors import ErrorCode
from advtex_server.refusal import ApiError

_RANGE = re.compile(r"bytes=\s*(\d{0,18})-(\d{0,18})\s*")


def chosen_range(header: str, size: int) -> tuple[int, int] | None:
    """First byte and the one after the last, or None for the whole file.

    Malformed and multiple ranges are ignored, as the RFC allows; one beyond the end is refused with 416.
    """
    match = _RANGE.fullmatch(header)
    if match is None or match.groups() == ("", ""):
        return None
    first, last = match.groups()
    if first == "":
        start, end = max(0, size - int(last)), size
    else:
        start = int(first)
        end = size if last == "" else min(int(last) + 1, size)
        if last != "" and int(last) < start:
            return None
    if start >= end:
        raise ApiError(
            ErrorCode.bad_request,
            f"the range {header!r} is beyond the file's {size} bytes",
            status=416,
            headers={"Content-Range": f"bytes */{size}"},
        )
    return start, end
