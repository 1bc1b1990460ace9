"""Everything that server and worker remember, opened in one call."""

from __future__ import annotations

from dataclasses import dataclass

from advtex_store.accounts import Accounts
from advtex_store.batches import Batches
from advtex_store.blobs import Blobs
from advtex_store.checks import Checks
from advtex_store.counters import Counters
from advtex_store.database import Database
from advtex_store.fleet import Fleet
from advtex_store.links import Links
from advtex_store.live import Live
from advtex_store.live_progress import LiveProgress
from advtex_store.overviews import Overviews
from advtex_store.places import open_blobs
from advtex_store.queue import JobQueue, connect_redis, connect_redis_briefly
from advtex_store.records import Records
from advtex_store.references import References
from advtex_store.results import Results
from advtex_store.sessions import Sessions
from advtex_store.settings import StoreSettings
from advtex_store.submissions import Submissions
from advtex_store.troubles import Troubles
from advtex_store.uploads import Uploads
from advtex_store.webhooks import Webhooks


@dataclass(frozen=True, slots=True)
class Store:
    """The truth (rows), the bytes (blobs) and the transport (queue)."""

    settings: StoreSettings
    database: Database
    records: Records
    checks: Checks
    uploads: Uploads
    submissions: Submissions
    accounts: Accounts
    sessions: Sessions
    links: Links
    overviews: Overviews
    batches: Batches
    blobs: Blobs
    references: References
    results: Results
    live: Live
    live_progress: LiveProgress
    webhooks: Webhooks
    counters: Counters
    troubles: Troubles
    queue: JobQueue
    fleet: Fleet

    def close(self) -> None:
        """Close connections."""
        self.database.close()
        self.queue.redis.close()
        self.live_progress.redis.close()


def open_store(settings: StoreSettings) -> Store:
    """Connect lazily: nothing is contacted before it is used. The schema must be up to date (`upgrade_database`)."""
    database = Database(settings.database)
    retention = settings.retention_seconds
    records = Records(database, lease_seconds=settings.lease_seconds)
    blobs = open_blobs(settings.blobs, settings.spool_dir)
    queue = JobQueue(connect_redis(settings))
    return Store(
        settings=settings,
        database=database,
        records=records,
        checks=Checks(records),
        uploads=Uploads(database, retention_seconds=retention),
        submissions=Submissions(database, retention_seconds=retention),
        accounts=Accounts(database),
        sessions=Sessions(database),
        links=Links(database),
        overviews=Overviews(database),
        batches=Batches(database),
        blobs=blobs,
        references=References(settings.reference_roots.split()),
        results=Results(records, blobs),
        live=Live(blobs),
        live_progress=LiveProgress(connect_redis_briefly(settings)),
        webhooks=Webhooks(database),
        counters=Counters(database),
        troubles=Troubles(database, blobs),
        queue=queue,
        fleet=Fleet(queue),
    )
