"""The zip that the page makes of a folder, also where it is larger than old zips can be; read by others."""

from __future__ import annotations

import json
import shutil
import subprocess
import zipfile
import zlib
from pathlib import Path

import pytest

from advtex_scan.archive import open_scan
from advtex_server.static_files import FOLDER

WRITE = """
import { closeSync, openSync, readFileSync, writeSync } from "node:fs";
import { zipParts } from "%s";
const [entries, path] = [JSON.parse(readFileSync(0)), "%s"];
const file = openSync(path, "w");
let at = 0;
for (const part of zipParts(entries)) { // a string is a body; a number, one of so many zeros
  if (typeof part === "number") { at += part; continue; }
  const bytes = typeof part === "string" ? Buffer.from(part) : part;
  writeSync(file, bytes, 0, bytes.length, at);
  at += bytes.length;
}
closeSync(file);
"""


def entry(name: str, text: str) -> dict[str, object]:
    return {"name": name, "size": len(text), "crc": zlib.crc32(text.encode()), "body": text}


def zipped(path: Path, entries: list[dict[str, object]]) -> Path:
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed: it runs the page's scripts here")
    script = WRITE % ((FOLDER / "zip.js").as_uri(), path)
    command = [node, "--input-type=module", "--eval", script]
    subprocess.run(command, input=json.dumps(entries), text=True, check=True, timeout=60)
    return path


@pytest.mark.parametrize("zeros", [0, (4 << 30) - 70, (4 << 30) - 2, 4 << 30, 5 << 30])
def test_files_and_offsets_of_any_size(tmp_path: Path, zeros: int) -> None:
    big: dict[str, object] = {"name": "scan/big.sens", "size": zeros, "crc": 0, "body": zeros}
    entries = [entry("scan/a.txt", "first"), big, entry("scan/ä.json", "last"), entry("scan/z", "")]
    path = zipped(tmp_path / "scan.zip", entries)
    with zipfile.ZipFile(path) as bundle:
        assert [info.file_size for info in bundle.infolist()] == [5, zeros, 4, 0]
        assert [bundle.read(name) for name in ("scan/a.txt", "scan/ä.json", "scan/z")] == [b"first", b"last", b""]
    with open_scan(path) as archive:
        assert archive.names() == ("a.txt", "big.sens", "z", "ä.json")
        assert archive.size("big.sens") == zeros
        assert archive.read("ä.json", 10) == b"last"


@pytest.mark.parametrize("count", [1, 65_535])
def test_any_number_of_files(tmp_path: Path, count: int) -> None:
    path = zipped(tmp_path / "scan.zip", [entry(f"{number}.txt", str(number)) for number in range(count)])
    with zipfile.ZipFile(path) as bundle:
        assert len(bundle.namelist()) == count
        assert bundle.read(f"{count - 1}.txt") == str(count - 1).encode()
