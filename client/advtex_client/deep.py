"""`check --deep`: conventions measured by the engine, where it is installed, in a process of its own."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from advtex_client.errors import ClientError

ENGINE = "torch"  # the package of this name comes with the client; what it needs does not


def deep_report(scan: Path, layout: str | None) -> dict[str, Any] | None:
    """Return what `advtex-engine check --json` says, None if too little can be measured. Raises ClientError."""
    if importlib.util.find_spec(ENGINE) is None:
        raise ClientError('check --deep needs the engine on this computer: pip install "advtex[worker]"')
    command = [sys.executable, "-m", "advtex_engine", "check", str(scan), "--json"]
    ran = subprocess.run([*command, *(["--layout", layout] if layout else [])], capture_output=True, text=True)
    try:
        report: dict[str, Any] | None = json.loads(ran.stdout)
    except ValueError as error:
        said = ran.stderr.strip().splitlines()
        why = said[-1] if said else f"it ended with exit code {ran.returncode}"
        raise ClientError(f"the engine could not measure {scan}: {why}") from error
    return report


def deep_lines(report: dict[str, Any] | None) -> list[str]:
    """Describe the report for people."""
    if report is None:
        return ["measured nothing: there is neither depth nor a mesh, or no two frames"]
    lines = [f"measured {report['frames']} frames: {report['summary']}"]
    for problem in report["problems"]:
        lines.append(f"{'error' if report['hopeless'] else 'warning':<8} {problem['where']}: {problem['message']}")
        lines.append(f"         -> {problem['remedy']}")
    if report["hopeless"]:
        lines.append("nothing agrees with anything: this scan would be rejected")
    elif not report["problems"]:
        lines.append("no other convention fits clearly better")
    return lines
