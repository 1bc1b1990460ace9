"""Findings, and the errors that carry them.

ScanFormatError             the scan cannot be read; `findings` say what, where and what helps
├── ArchiveError            not a folder or zip, truncated, or a member that does not decode
│   ├── UnsafeArchiveError  a name, link, overlap, encryption or nesting that is never accepted
│   └── LimitError          more entries, bytes or compression than the limits allow
├── ImageError              an image whose header is not one, or too large
└── MeshError               a mesh that is broken or of an unsupported kind
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Literal

Severity = Literal["error", "warning", "info"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")
NAMED_PLACES = 3  # a grouped finding names this many files and counts the rest


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing to know about a scan: how bad, a stable code, the file or frame, what is wrong and what helps."""

    severity: Severity
    code: str
    where: str
    message: str
    remedy: str = ""

    def __str__(self) -> str:
        place = f"{self.where}: " if self.where else ""
        return f"{place}{self.message}" + (f" ({self.remedy})" if self.remedy else "")


class ScanFormatError(Exception):
    """The base of all errors of this package. The message joins the findings, each with its file and remedy."""

    def __init__(self, *findings: Finding) -> None:
        super().__init__("; ".join(map(str, findings)))
        self.findings = findings


class ArchiveError(ScanFormatError):
    """The folder or zip, or one of its members, cannot be read."""


class UnsafeArchiveError(ArchiveError):
    """The archive holds something that is never accepted."""


class LimitError(ArchiveError):
    """The archive or a member is larger than the limits allow."""


class ImageError(ScanFormatError):
    """A file is no image, or an image of a kind or size that is not accepted."""


class MeshError(ScanFormatError):
    """A mesh file is broken or of an unsupported kind."""


@dataclass(slots=True)
class _Group:
    first: Finding
    places: list[str] = field(default_factory=list)
    alike: bool = True  # all messages are the first one's

    def joined(self) -> Finding:
        if len(self.places) == 1:
            return self.first
        where = ", ".join(self.places[:NAMED_PLACES])
        if len(self.places) > NAMED_PLACES:
            where += f" and {len(self.places) - NAMED_PLACES} more"
        extent = f"{len(self.places)} in all" if self.alike else f"the first of {len(self.places)}"
        return replace(self.first, where=where, message=f"{self.first.message} ({extent})")


class Findings:
    """Collects findings; those of one severity, code and remedy become one that names the first few places."""

    def __init__(self) -> None:
        self._groups: dict[tuple[Severity, str, str], _Group] = {}

    def add(self, finding: Finding) -> None:
        """Add one finding to its group."""
        key = (finding.severity, finding.code, finding.remedy)
        group = self._groups.setdefault(key, _Group(finding))
        group.places.append(finding.where)
        group.alike &= finding.message == group.first.message

    def extend(self, findings: Iterable[Finding]) -> None:
        """Add each of `findings`."""
        for finding in findings:
            self.add(finding)

    def error(self, code: str, where: str, message: str, remedy: str) -> None:
        """Add something that must be mended before the scan can be textured."""
        self.add(Finding("error", code, where, message, remedy))

    def warning(self, code: str, where: str, message: str, remedy: str) -> None:
        """Add something that the user should look at; the scan can be textured."""
        self.add(Finding("warning", code, where, message, remedy))

    def info(self, code: str, where: str, message: str, remedy: str = "") -> None:
        """Add something that was assumed or left out."""
        self.add(Finding("info", code, where, message, remedy))

    def count(self, code: str) -> int:
        """Return how many findings with this code were added."""
        return sum(len(group.places) for (_, known, _), group in self._groups.items() if known == code)

    def result(self) -> tuple[Finding, ...]:
        """Return all groups, errors first, each in the order of its first finding."""
        findings = (group.joined() for group in self._groups.values())
        return tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))
