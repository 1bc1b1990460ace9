"""A worker like `python -m advtex_worker.main`, with an engine of tests: `run_worker.py NAME` of `fake_engines`, or
`module:function`."""

from __future__ import annotations

import argparse
import sys

from advtex_store.logs import configure_logs
from advtex_worker.leaving import add_arguments, read_stay
from advtex_worker.main import serve
from advtex_worker.settings import WorkerSettings
from advtex_worker.tasks import Host

if __name__ == "__main__":
    configure_logs()
    parser = argparse.ArgumentParser()
    parser.add_argument("engine")
    add_arguments(parser)
    told = parser.parse_args()
    host = Host(WorkerSettings(), engine=told.engine if ":" in told.engine else f"fake_engines:{told.engine}")
    sys.exit(serve(host, [sys.executable, __file__, told.engine], read_stay(told)))
