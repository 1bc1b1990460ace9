"""Scans are checked after the job is made."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("jobs", sa.Column("checked_at", sa.Double(), nullable=True))
    op.execute("UPDATE jobs SET checked_at = created_at")  # until now a job was made once its scan was checked


def downgrade() -> None:
    # Older releases know no job that is checked: its scan is judged where it is read, by the worker.
    op.execute(
        "UPDATE jobs SET state = 'queued', attempt = attempt + 1, worker = NULL, lease_expires_at = NULL, deaths = 0"
        " WHERE state = 'checking'"
    )
    op.drop_column("jobs", "checked_at")
