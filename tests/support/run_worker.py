"""A worker like `python -m advtex_worker.main`, with an engine of tests: `run_worker.py NAME` of `fake_engines`, or
`module:function`."""

from __future__ import annotations

import sys

from advtex_store.logs import configure_logs
from advtex_worker.main import serve
from advtex_worker.settings import WorkerSettings
from advtex_worker.tasks import Host

if __name__ == "__main__":
    configure_logs()
    host = Host(WorkerSettings(), engine=sys.argv[1] if ":" in sys.argv[1] else f"fake_engines:{sys.argv[1]}")
    serve(host, [sys.executable, __file__, sys.argv[1]])
