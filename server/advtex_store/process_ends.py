"""How processes end: a child with its parent, and any of them in words. It needs the standard library alone: the
process of a check lives no longer than other imports take."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

PR_SET_PDEATHSIG = 1  # <linux/prctl.h>


def die_with_parent(parent_pid: int, signum: signal.Signals) -> None:
    """Have the kernel (Linux) send `signum` to this process when its parent ends.

    The kernel watches the thread that made this process, so parents start children from a thread that lives as long
    as they do. If the parent was gone before the call, this process exits at once.
    """
    if not sys.platform.startswith("linux"):
        return
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_PDEATHSIG, int(signum), 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
    if os.getppid() != parent_pid:
        os._exit(1)


def how_it_ended(code: int) -> str:
    """How a process ended, for people, as the end of a sentence about it: its return code as `subprocess` gives it."""
    if code >= 0:
        return f"ended without a result (exit code {code})"
    known = {signal.SIGKILL: "was killed (out of memory?)", signal.SIGSEGV: "crashed in native code"}
    try:
        signum = signal.Signals(-code)
    except ValueError:
        return f"was ended by signal {-code}"
    return f"{known.get(signum, 'was ended')}: {signum.name}"
