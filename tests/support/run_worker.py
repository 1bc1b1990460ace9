"""A worker like `python -m advtex_worker.main`, with an engine of `fake_engines`: `run_worker.py NAME`."""

from __future__ import annotations

import sys

from advtex_store.logs import configure_logs
from advtex_worker.main import work
from advtex_worker.settings import WorkerSettings
from advtex_worker.tasks import Host

if __name__ == "__main__":
    configure_logs()
    work(Host(WorkerSettings(), engine=f"fake_engines:{sys.argv[1]}"))
