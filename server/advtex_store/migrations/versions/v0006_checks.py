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
