"""Which schemas this release works on, and the rule of its migrations.

While a fleet is upgraded, servers and workers of two releases share one database: it comes first, then the servers,
then the workers, and back in the other order. So, in `migrations/versions`:

- Within a generation, which is the first two digits of a revision, a migration only adds: tables, indexes, and columns
  that may be null, have a default in the database, or are computed there. What is there keeps its name, its type and
  its meaning, and nothing that older code writes is refused. What becomes superfluous goes with the next generation.
- What cannot be done so begins a new generation. No older release works on it: all of them are stopped first.
- Each has a `downgrade`, which may lose what only it knew.
- `tests/store/databases` has a populated database of each revision.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection

from advtex_store.errors import SchemaRefused

MIGRATIONS = Path(__file__).parent / "migrations"
GENERATION_DIGITS = 2


@cache
def revisions() -> tuple[str, ...]:
    """All that this release knows, oldest first."""
    found = ScriptDirectory(str(MIGRATIONS)).walk_revisions()
    return tuple(script.revision for script in found)[::-1]


@dataclass(frozen=True, slots=True)
class Schema:
    """The revision of a database, None for an empty one, as this release sees it."""

    revision: str | None

    @classmethod
    def of(cls, connection: Connection) -> Schema:
        return cls(MigrationContext.configure(connection).get_current_revision())

    @property
    def behind(self) -> str | None:
        """Why this release cannot work on it yet: a server of this release brings it up to date when it starts."""
        newest = revisions()[-1]
        if self.revision == newest or not self._known:
            return None
        found = "is empty" if self.revision is None else f"has schema {self.revision}"
        return (
            f"the database {found} and this release needs {newest}: start a server of this release first, or run "
            "`advtex-server migrate`"
        )

    @property
    def ahead(self) -> bool:
        """Whether a newer release has added to it what this one does not know, and can do without."""
        newest = revisions()[-1]
        if self._known or self.revision is None:
            return False
        return self.revision > newest and self.revision[:GENERATION_DIGITS] == newest[:GENERATION_DIGITS]

    def check(self) -> None:
        """SchemaRefused for one that this release does not know and cannot work on: no waiting helps."""
        if not self._known and not self.ahead:
            raise SchemaRefused(
                f"the database has schema {self.revision}, which this release does not know (its own is "
                f"{revisions()[-1]}): install the release that made it, or let that one's `advtex-server migrate --to "
                f"{revisions()[-1]}` take the database back"
            )

    @property
    def _known(self) -> bool:
        return self.revision is None or self.revision in revisions()
