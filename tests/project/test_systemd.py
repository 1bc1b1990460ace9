"""The unit for systemd: what it starts, when again, and how long it waits."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

from advtex_worker.leaving import AGAIN
from advtex_worker.main import argument_parser
from advtex_worker.settings import WorkerSettings

UNIT = Path(__file__).parents[2] / "docker" / "systemd" / "advtex-worker.service"


def service() -> dict[str, str]:
    return dict(re.findall(r"^(\w+)=(.*)$", UNIT.read_text(), re.MULTILINE))


def test_it_starts_the_worker_with_settings_that_it_reads() -> None:
    told = service()
    command, *arguments = shlex.split(told["ExecStart"])
    assert Path(command).name == argument_parser().prog
    argument_parser().parse_args(arguments)
    given = dict(entry.split("=") for entry in shlex.split(told["Environment"]))
    assert {name.removeprefix("ADVTEX_").lower() for name in given} <= set(WorkerSettings.model_fields)
    assert given["ADVTEX_DATA_DIR"] == f"/var/lib/{told['StateDirectory']}"


def test_it_is_started_again_when_that_helps_and_has_time_for_its_checkpoint() -> None:
    told = service()
    assert told["Restart"] == "on-failure"
    prevented = {int(code) for code in told["RestartPreventExitStatus"].split()}
    assert prevented == {1, 2}, "it cannot work"
    assert AGAIN not in prevented
    grace = float(dict(entry.split("=") for entry in shlex.split(told["Environment"]))["ADVTEX_GRACE_SECONDS"])
    assert float(told["TimeoutStopSec"]) > 2 * grace
    assert told["KillMode"] == "mixed", "SIGTERM is for the worker, which stops its runner"
