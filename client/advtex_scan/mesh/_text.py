"""Numbers that stand in lines of text, read in blocks.

Nearly every file has thousands of lines that differ in their digits alone. Where that is so, the scanner of the `json`
module reads all of their numbers at once, several times faster than `split` and `float` would; the readers go through
all other lines word by word, and give the same numbers.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, BinaryIO

BLOCK = 1 << 18  # bytes that are read at a time; no line may be longer
INTEGERS = b"0123456789-"
NUMERALS = b"0123456789+-.eE"
_COMMAS = bytes.maketrans(b" \n/", b",,,")


class TextReader:
    """The lines of a stream, in blocks; whatever ends them in the file, they end with a line feed here."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._rest = b""

    def block(self, lines: int | None = None) -> bytes:
        """The next whole lines, about BLOCK bytes and at most `lines` of them; empty at the end of the stream.

        A line that goes on behind a backslash is not torn apart. Raises ValueError for a line longer than BLOCK.
        """
        text, ended = self._rest, False
        if len(text) < BLOCK:
            piece = self._stream.read(BLOCK)
            if piece.endswith(b"\r"):
                piece += self._stream.read(1)
            ended = not piece
            text += piece.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        if ended and text and not text.endswith(b"\n"):
            text += b"\n"
        end = len(text) if ended else text.rfind(b"\n") + 1
        while not ended and text.endswith(b"\\\n", 0, end):
            end = text.rfind(b"\n", 0, end - 1) + 1
        if not end and len(text) >= BLOCK:
            raise ValueError(f"a line is longer than {BLOCK} bytes")
        if lines is not None and text.count(b"\n", 0, end) > lines:
            end = len(text) - len(text.split(b"\n", lines)[-1])
        self._rest = text[end:]
        return text[:end] if end or ended else self.block(lines)


def tidy(text: bytes) -> bytes:
    """Lines with one space between their words, and none around them."""
    for found, instead in ((b"\t", b" "), (b"  ", b" "), (b" \n", b"\n"), (b"\n ", b"\n")):
        while found in text:
            text = text.replace(found, instead)
    return text.lstrip(b" ")


def common_form(text: bytes, numerals: bytes) -> bytes | None:
    """What all lines of `text` are without `numerals`; None if they differ in more than these."""
    form = text.translate(None, numerals)
    first = form[: form.find(b"\n") + 1]
    return first[:-1] if first * text.count(b"\n") == form else None


def table(text: bytes, whole: Callable[[str], float] = int) -> tuple[list[Any], int] | None:
    """The numbers of lines of nothing but numbers, in turn, and how many each line has.

    whole: makes a number of a numeral without a point. None if the lines differ in length or hold something else, or
    numerals that are no JSON, such as `.5` and `nan`: these are to be read word by word.
    """
    form = common_form(text, NUMERALS)
    if form is None or form.strip(b" "):
        return None
    found = numbers(text, whole)
    return None if found is None else (found, len(form) + 1)


def numbers(text: bytes, whole: Callable[[str], float] = int) -> list[Any] | None:
    """All numbers of `text`, between which stands one space, line break or slash each; None as in `table`."""
    try:
        found: list[Any] = json.loads("[" + text[:-1].translate(_COMMAS).decode() + "]", parse_int=whole)
    except ValueError:
        return None
    return found
