"""Which member names are accepted, and which are ignored."""

from __future__ import annotations

import re

MAX_NAME = 1024
JUNK_FILES = frozenset({".DS_Store", "Thumbs.db", "desktop.ini"})
ARCHIVE_SUFFIXES = (".zip", ".tar", ".tgz", ".gz", ".bz2", ".xz", ".zst", ".7z", ".rar")
_DRIVE = re.compile(r"[A-Za-z]:")


def unsafe_reason(name: str) -> str | None:
    """Return why a member's name is refused, None if it is accepted.

    Accepted are relative paths of printable characters without backslash, with no part that is empty, `.` or `..`.
    """
    parts = name.removesuffix("/").split("/")
    if not name or len(name) > MAX_NAME:
        return f"the name is empty or longer than {MAX_NAME} characters"
    if not name.isprintable():
        return "the name holds characters that cannot be printed"
    if name.startswith("/") or _DRIVE.match(name):
        return "the name is an absolute path"
    if "\\" in name:
        return "the name holds a backslash"
    if ".." in parts:
        return "the name leaves the scan through '..'"
    if "." in parts or "" in parts:
        return "the name holds an empty part"
    return None


def is_junk(name: str) -> bool:
    """Tell whether this is a file that operating systems leave in folders and zips."""
    parts = name.split("/")
    return parts[0] == "__MACOSX" or parts[-1] in JUNK_FILES or parts[-1].startswith("._")


def is_nested_archive(name: str) -> bool:
    """Tell whether this is an archive inside the archive: those are refused by name and never looked into."""
    return name.lower().endswith(ARCHIVE_SUFFIXES)


def common_folder(names: list[str]) -> str:
    """Return the folder, with its slash, below which all files lie; empty if they do not share one."""
    if not names:
        return ""
    first, last = min(names).split("/")[:-1], max(names).split("/")[:-1]
    shared = 0
    while shared < min(len(first), len(last)) and first[shared] == last[shared]:
        shared += 1
    return "".join(f"{part}/" for part in first[:shared])
