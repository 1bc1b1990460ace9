"""What children may know: a list of names, and nothing of the memory of those that start them."""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path

import pytest

from advtex_store.secrecy import PR_SET_DUMPABLE, hide_environment, public_environment

NOBODY = 65534


def test_children_get_what_is_on_the_list_and_no_secrets() -> None:
    public = {
        "PATH": "/bin",
        "ADVTEX_VGG_WEIGHTS": "/weights",
        "ADVTEX_LPIPS_WEIGHTS": "/weights",
        "ADVTEX_ENGINE_CACHE": "/cache",
        "PYTHONPATH": "/lib",
        "CUDA_HOME": "/cuda",
        "OMP_NUM_THREADS": "2",
        "LC_ALL": "C.UTF-8",
    }
    secret = {
        "ADVTEX_DATABASE_URL": "postgresql://user:secret@host",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "DATABASE_URL": "postgresql://user:secret@host",
        "PGPASSWORD": "secret",
        "HTTPS_PROXY": "http://user:secret@proxy",
        "GITHUB_TOKEN": "secret",
        "SENTRY_DSN": "https://secret@host",
        "path": "lower case is another name",
    }
    assert public_environment(public | secret) == public


def readable_by_a_child(parent: int) -> bool:
    """Whether a process that this one forks can read the environment of `parent`."""
    pid = os.fork()
    if pid == 0:
        try:
            Path(f"/proc/{parent}/environ").read_bytes()
        except PermissionError:
            os._exit(1)
        except BaseException:
            os._exit(2)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    assert code in (0, 1)
    return code == 0


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs Linux's /proc")
def test_a_child_cannot_read_the_environment_of_its_parent() -> None:
    """As a user without rights: root reads everything, and is told so."""
    if os.geteuid() == 0:
        reason = hidden_in_a_fork(None)
        assert reason == "told why not"
    assert hidden_in_a_fork(NOBODY if os.geteuid() == 0 else os.geteuid()) == "readable, then hidden"


def hidden_in_a_fork(user: int | None) -> str:
    """What a forked process of that user finds, which hides itself; None: of this one's."""
    receiving, sending = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            if user is None:
                found = "told why not" if "root" in (hide_environment() or "") else "not told"
            else:
                if user != os.geteuid():
                    os.setgid(user)
                    os.setuid(user)
                ctypes.CDLL(None).prctl(PR_SET_DUMPABLE, 1, 0, 0, 0)  # a change of user hides it, too
                before, reason, after = readable_by_a_child(os.getpid()), hide_environment(), None
                after = readable_by_a_child(os.getpid())
                found = "readable, then hidden" if (before, reason, after) == (True, None, False) else "otherwise"
            os.write(sending, found.encode())
        finally:
            os._exit(0)
    os.close(sending)
    os.waitpid(pid, 0)
    with os.fdopen(receiving) as told:
        return told.read()
