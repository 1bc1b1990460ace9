"""The elements of a PLY file, in runs of rows: rows whose lists have the same lengths are read at once."""

from __future__ import annotations

import struct
from array import array
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, BinaryIO

from advtex_scan.mesh._packed import gather
from advtex_scan.mesh._text import BLOCK, TextReader, table, tidy

SHORT_RUN = 16  # rows; where runs are shorter, rows are read one by one, so many of them before the next try
ONE_BY_ONE = 4096


@dataclass(frozen=True, slots=True)
class Property:
    """A property's name, the struct code of its values, and of its length if it is a list (else empty)."""

    name: str
    kind: str
    count: str = ""

    @property
    def whole(self) -> bool:
        """Whether it is a list of integers, thus of indices."""
        return bool(self.count) and self.kind not in "fd"


@dataclass(frozen=True, slots=True)
class Element:
    """An element's name, how many rows it has, and what each of them holds."""

    name: str
    count: int
    properties: list[Property] = field(default_factory=list)

    def least_size(self, text: bool) -> int:
        """Bytes that each row takes at least."""
        if text:
            return 2 * len(self.properties)
        return sum(struct.calcsize("<" + (one.count or one.kind)) for one in self.properties)


@dataclass(frozen=True, slots=True)
class Run:
    """Rows one after the other.

    lengths: how many values of a property each row has, 1 unless it is a list; one number if all have as many
    values: of the properties that were asked for, row by row; integers of a list are "q" in an array
    """

    rows: int
    lengths: Mapping[str, int | Sequence[int]]
    values: Mapping[str, Sequence[Any]]


class BinaryRows:
    """Rows of a binary file. size: bytes that are left in the stream; no list is believed to exceed them."""

    def __init__(self, stream: BinaryIO, size: int, order: str) -> None:
        self._stream, self._left, self._order = stream, size, order
        self._data, self._at = b"", 0

    def runs(self, element: Element, wanted: Collection[str]) -> Iterator[Run]:
        """All rows of the element that comes next, with the properties that are wanted. Raises EOFError, ValueError."""
        done = 0
        while done < element.count:
            lengths = self._lengths(element)
            run = self._run(element, lengths, element.count - done, wanted)
            yield run
            done += run.rows
            if run.rows < SHORT_RUN and done < element.count:
                few = min(ONE_BY_ONE, element.count - done)
                yield self._one_by_one(element, few, wanted)
                done += few

    def _fill(self, size: int) -> None:
        """Have at least `size` bytes at hand."""
        held = len(self._data) - self._at
        if held < size:
            if size - held > self._left:
                raise EOFError("the file ends too early")
            more = self._stream.read(max(size - held, min(BLOCK, self._left)))
            self._data, self._at = self._data[self._at :] + more, 0
            self._left -= len(more)
            if len(self._data) < size:
                raise EOFError("the file ends too early")

    def _lengths(self, element: Element) -> tuple[int, ...]:
        """How many values the next row has of each property."""
        offset, lengths = 0, []
        for one in element.properties:
            length = 1
            if one.count:
                layout = struct.Struct(self._order + one.count)
                self._fill(offset + layout.size)
                length = int(layout.unpack_from(self._data, self._at + offset)[0])
                offset += layout.size
                if length < 0:
                    raise ValueError(f"a list of {length} values")
            offset += length * struct.calcsize("<" + one.kind)
            lengths.append(length)
        self._fill(offset)
        return tuple(lengths)

    def _run(self, element: Element, lengths: tuple[int, ...], rows: int, wanted: Collection[str]) -> Run:
        """The next rows, at most `rows`, whose lists are as long as the first one's."""
        counts, values = list[int](), list[tuple[Property, int, int]]()  # offsets of lists' lengths, and of values
        stride = 0
        for one, length in zip(element.properties, lengths, strict=True):
            if one.count:
                width = struct.calcsize("<" + one.count)
                counts += range(stride, stride + width)
                stride += width
            values.append((one, stride, length))
            stride += length * struct.calcsize("<" + one.kind)
        rows = max(1, min(rows, BLOCK // stride))
        self._fill(min(rows * stride, len(self._data) - self._at + self._left))
        rows = min(rows, (len(self._data) - self._at) // stride)
        data = self._data[self._at : self._at + rows * stride]
        for offset in counts:
            column = data[offset::stride]
            rows = min(rows, len(column) - len(column.lstrip(column[:1])))
        data = data[: rows * stride]
        self._at += rows * stride
        found = {
            one.name: gather(data, stride, offset, one.kind, length, self._order)
            for one, offset, length in values
            if one.name in wanted
        }
        return Run(rows, _by_name(element, lengths), found)

    def _one_by_one(self, element: Element, rows: int, wanted: Collection[str]) -> Run:
        layouts = dict[tuple[int, ...], tuple[struct.Struct, dict[str, slice]]]()
        many = _Rows(element, wanted)
        for _ in range(rows):
            lengths = self._lengths(element)
            if lengths not in layouts:
                layouts[lengths] = self._layout(element, lengths)
            layout, places = layouts[lengths]
            row = layout.unpack_from(self._data, self._at)
            self._at += layout.size
            for name, (sizes, values) in many.columns.items():
                found = row[places[name]]
                sizes.append(len(found))
                values += found
        return many.run()

    def _layout(self, element: Element, lengths: tuple[int, ...]) -> tuple[struct.Struct, dict[str, slice]]:
        """A row as a whole, and the places of a property's values among all that it holds."""
        code, place, places = self._order, 0, dict[str, slice]()
        for one, length in zip(element.properties, lengths, strict=True):
            code += f"{one.count}{length}{one.kind}"
            place += bool(one.count)
            places[one.name] = slice(place, place + length)
            place += length
        return struct.Struct(code), places


class TextRows:
    """Rows of an ascii file, one in each line; what stands in a line behind its row is passed over."""

    def __init__(self, stream: BinaryIO) -> None:
        self._reader = TextReader(stream)

    def runs(self, element: Element, wanted: Collection[str]) -> Iterator[Run]:
        """As those of `BinaryRows`."""
        whole = all(one.whole for one in element.properties if one.name in wanted)
        done = 0
        while done < element.count:
            text = self._reader.block(element.count - done)
            if not text:
                raise EOFError("the file ends too early")
            done += text.count(b"\n")
            found = table(tidy(text), int if whole else float)
            run = None if found is None else _alike(element, *found, wanted)
            if run is None:
                yield _word_by_word(element, text, wanted)
            else:
                yield run


def _alike(element: Element, numbers: list[Any], columns: int, wanted: Collection[str]) -> Run | None:
    """The rows of lines of so many numbers each; None if their lists differ in length or do not fit into the line."""
    rows, column = len(numbers) // columns, 0
    lengths, values = list[int](), dict[str, Sequence[Any]]()
    for one in element.properties:
        length = 1
        if one.count and column < columns:
            counts = numbers[column::columns]
            length = int(counts[0])
            if length < 0 or counts.count(length) < rows:
                return None
            column += 1
        if column + length > columns:
            return None
        if one.name in wanted:
            flat: array[Any] = array("q" if one.whole else "d", bytes(8 * rows * length))
            for number in range(length):
                every = numbers[column + number :: columns]
                flat[number::length] = array("q", map(int, every)) if one.whole else array("d", every)
            values[one.name] = flat
        lengths.append(length)
        column += length
    return Run(rows, _by_name(element, lengths), values)


def _word_by_word(element: Element, text: bytes, wanted: Collection[str]) -> Run:
    """The rows of any lines. Raises EOFError, ValueError."""
    many = _Rows(element, wanted)
    whole = {one.name for one in element.properties if one.whole}
    for line in text.splitlines():
        words, at = line.split(), 0
        for one in element.properties:
            length = 1
            if one.count and at < len(words):
                length, at = int(float(words[at])), at + 1
            if length < 0:
                raise ValueError(f"a list of {length} values")
            if at + length > len(words):
                raise EOFError("a line is too short")
            if one.name in many.columns:
                sizes, values = many.columns[one.name]
                sizes.append(length)
                numbers = map(float, words[at : at + length])
                values.extend(map(int, numbers) if one.name in whole else numbers)
            at += length
    return many.run()


class _Rows:
    """Rows that are read one by one. columns: by the properties that are wanted, each row's length, and all values."""

    def __init__(self, element: Element, wanted: Collection[str]) -> None:
        self.columns = {one.name: (list[int](), list[Any]()) for one in element.properties if one.name in wanted}

    def run(self) -> Run:
        rows = max((len(sizes) for sizes, _ in self.columns.values()), default=0)
        lengths = {name: sizes for name, (sizes, _) in self.columns.items()}
        return Run(rows, lengths, {name: values for name, (_, values) in self.columns.items()})


def _by_name(element: Element, lengths: Sequence[int]) -> dict[str, int]:
    return {one.name: length for one, length in zip(element.properties, lengths, strict=True)}
