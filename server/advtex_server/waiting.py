"""Why a job waits, in words for its owner.

What is true of a class of workers, rows tell (`Records.explain`). What is true of an owner, a batch or this moment is
found out when somebody looks: it would have to be told to each row that comes to wait, and be taken back from each.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

from advtex_contract.jobs import TERMINAL, WAITING, JobState
from advtex_store.lines import Full
from advtex_store.models import JobRow
from advtex_store.store import Store

IN_CHECK = "its scan is being checked"
IN_LINE = "a worker takes it when its turn comes"
PAUSED = "its batch is paused; it waits until the batch is resumed"
BATCH_FULL = "as many jobs of its batch run as may at a time ({most}); it begins when one of them has ended"
OWNER_FULL = "as many of your jobs run as may at a time ({most}); it begins when one of them has ended"
LATE = "its deadline has passed, it runs all the same"
USUAL: Mapping[str, str] = {JobState.checking: IN_CHECK, **dict.fromkeys(WAITING, IN_LINE)}


def tell_why(store: Store, owner: str, rows: Sequence[JobRow]) -> None:
    """Put into the waiting ones of an owner's rows, which their session has let go of, what keeps them from their turn.

    That no worker runs, or none that is large enough, stays what a row says: more of a limit would not help.
    """
    waiting = [row for row in rows if row.state in WAITING]
    if not waiting:
        return
    allowance = store.batches.allowance(owner)
    for row in waiting:
        full = allowance.full(owner, row.batch or "")
        if full is Full.paused:
            row.waiting_reason = PAUSED
        elif full is not None and not row.waiting_reason:
            words = BATCH_FULL if full is Full.batch else OWNER_FULL
            row.waiting_reason = words.format(most=allowance.most(owner, row.batch or "", full))


def waiting_reason(row: JobRow, usual: Mapping[str, str] = USUAL) -> str:
    """What the row says, or else what is usual in its state; and that it is late. Empty once it has ended."""
    if row.state in TERMINAL:
        return ""
    late = LATE if row.state in WAITING and is_late(row) else ""
    return "; ".join(filter(None, (row.waiting_reason or usual.get(row.state, ""), late)))


def is_late(row: JobRow) -> bool:
    """Whether it ended after its deadline, or goes on though that has passed."""
    return row.deadline is not None and (row.finished_at or time.time()) > row.deadline
