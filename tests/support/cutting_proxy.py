"""A bad network: forwards TCP connections, and breaks each one after a random number of bytes from the client."""

from __future__ import annotations

import random
import socket
import threading
from contextlib import suppress
from typing import Self
from urllib.parse import urlsplit

BUFFER = 256 << 10  # of the sockets: what a broken line takes with it


class CuttingProxy:
    """`url` leads to `target`. A context manager. cuts: how many connections it broke so far.

    received: bytes that it read from clients, headers and all.
    """

    def __init__(self, target: str, seed: int, least: int, most: int) -> None:
        parts = urlsplit(target)
        assert parts.hostname is not None
        assert parts.port is not None
        self._target = (parts.hostname, parts.port)
        self._random = random.Random(seed)
        self._span = (least, most)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
        self._threads: list[threading.Thread] = []
        self._open: set[socket.socket] = set()
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        self.cuts = self.received = 0

    def __enter__(self) -> Self:
        self._start(self._accept)
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for line in list(self._open):
            _close(line)
        for thread in self._threads:
            thread.join(10)

    def _start(self, run: object, *arguments: object) -> None:
        thread = threading.Thread(target=run, args=arguments, daemon=True)  # type: ignore[arg-type]
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            server = socket.create_connection(self._target)
            server.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER)
            self._open |= {client, server}
            self._start(self._forward, client, server, self._random.randint(*self._span))
            self._start(self._forward, server, client, None)

    def _forward(self, source: socket.socket, target: socket.socket, left: int | None) -> None:
        with suppress(OSError):
            while chunk := source.recv(1 << 16):
                if left is not None:
                    left -= len(chunk)
                    self.received += len(chunk)
                    if left <= 0:
                        self.cuts += 1
                        break
                target.sendall(chunk)
        for line in (source, target):
            _close(line)
            self._open.discard(line)


def _close(line: socket.socket) -> None:
    with suppress(OSError):
        line.shutdown(socket.SHUT_RDWR)
    line.close()
