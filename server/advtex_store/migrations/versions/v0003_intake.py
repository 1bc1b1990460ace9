"""Uploads that are resumed, scans by reference, batches."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("uploads", sa.Column("announced_sha256", sa.String(length=255), nullable=True))
    op.add_column("uploads", sa.Column("holder", sa.String(length=255), nullable=True))
    op.add_column("uploads", sa.Column("tus_metadata", sa.Text(), nullable=False, server_default=""))
    op.add_column("uploads", sa.Column("source", sa.Text(), nullable=True))
    op.create_index(op.f("ix_uploads_announced_sha256"), "uploads", ["announced_sha256"], unique=False)
    op.execute("update uploads set announced_sha256 = sha256")
    op.add_column("jobs", sa.Column("source", sa.Text(), nullable=True))
    op.add_column("jobs", sa.Column("batch", sa.String(length=255), nullable=True))
    op.create_index("ix_jobs_owner_batch_id", "jobs", ["owner", "batch", "id"], unique=False)


def downgrade() -> None:
    op.drop_index("ix_jobs_owner_batch_id", "jobs")
    for column in ("batch", "source"):
        op.drop_column("jobs", column)
    op.drop_index(op.f("ix_uploads_announced_sha256"), "uploads")
    for column in ("source", "tus_metadata", "holder", "announced_sha256"):
        op.drop_column("uploads", column)
