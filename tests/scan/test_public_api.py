"""The package's face: sorted names, standard library only."""

from __future__ import annotations

import subprocess
import sys

import advtex_scan


def test_all_is_sorted_and_complete():
    names = advtex_scan.__all__
    assert names == sorted(names, key=lambda name: (not name.isupper(), not name[0].isupper(), name))
    assert all(hasattr(advtex_scan, name) for name in names)
    public = {name for name in vars(advtex_scan) if not name.startswith("_")}
    modules = {name for name in public if type(vars(advtex_scan)[name]).__name__ == "module"}
    assert public - modules == set(names)


def test_importing_needs_the_standard_library_only():
    code = (
        "import sys; before = set(sys.modules); import advtex_scan; "
        "roots = {name.split('.')[0] for name in set(sys.modules) - before}; "
        "print(sorted(roots - set(sys.stdlib_module_names) - {'advtex_scan'}))"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert output.stdout.strip() == "[]"
