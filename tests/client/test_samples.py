"""Real scans survive being packed: the server finds in the zip what the check found in the folder."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from advtex_client.uploads import packed
from advtex_scan.check import check_scan

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("ADVTEX_DATA", ROOT / ".." / "shared" / "data"))


@pytest.mark.data
@pytest.mark.parametrize("name", ["apt0_kitchen", "redkitchen_A", "shelf_bin"])
def test_a_packed_folder_is_the_same_scan(name: str) -> None:
    folder = DATA / "scans" / name
    if not folder.is_dir():
        pytest.skip(f"the sample scans are not at {DATA}")
    report = check_scan(folder)
    assert report.ok
    with packed(folder) as archive:
        assert check_scan(archive.path).to_dict() == report.to_dict()
