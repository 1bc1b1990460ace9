"""Quotas, priorities, needs, retention per job, tallies, webhooks."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

RETENTION_SECONDS = 30 * 86400  # what jobs made before this were promised


def upgrade() -> None:
    op.add_column("api_keys", sa.Column("max_active_jobs", sa.Integer(), nullable=True))
    op.add_column("api_keys", sa.Column("max_bytes", sa.BigInteger(), nullable=True))
    for column in (
        sa.Column("priority", sa.Integer(), nullable=False, server_default="0"),
        sa.Column("memory_bytes", sa.BigInteger(), nullable=False, server_default="0"),
        sa.Column("waiting_reason", sa.String(length=255), nullable=False, server_default=""),
        sa.Column("retention_seconds", sa.Integer(), nullable=False, server_default=str(RETENTION_SECONDS)),
        sa.Column("tidied_at", sa.Double(), nullable=True),
    ):
        op.add_column("jobs", column)
    op.create_table(
        "tallies",
        sa.Column("name", sa.String(length=255), nullable=False),
        sa.Column("label", sa.String(length=255), nullable=False),
        sa.Column("count", sa.BigInteger(), nullable=False),
        sa.Column("total", sa.Double(), nullable=False),
        sa.PrimaryKeyConstraint("name", "label"),
    )
    _create_webhooks()


def downgrade() -> None:
    for table in ("deliveries", "webhooks", "tallies"):
        op.drop_table(table)
    for column in ("tidied_at", "retention_seconds", "waiting_reason", "memory_bytes", "priority"):
        op.drop_column("jobs", column)
    for column in ("max_bytes", "max_active_jobs"):
        op.drop_column("api_keys", column)


def _create_webhooks() -> None:
    op.create_table(
        "webhooks",
        sa.Column("id", sa.String(length=255), nullable=False),
        sa.Column("owner", sa.String(length=255), nullable=False),
        sa.Column("url", sa.Text(), nullable=False),
        sa.Column("secret", sa.String(length=255), nullable=False),
        sa.Column("events", sa.JSON(), nullable=False),
        sa.Column("failures", sa.Integer(), nullable=False),
        sa.Column("last_error", sa.Text(), nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.Column("disabled_at", sa.Double(), nullable=True),
        sa.PrimaryKeyConstraint("id"),
    )
    op.create_index(op.f("ix_webhooks_owner"), "webhooks", ["owner"], unique=False)
    op.create_table(
        "deliveries",
        sa.Column("id", sa.String(length=255), nullable=False),
        sa.Column("webhook_id", sa.String(length=255), nullable=False),
        sa.Column("body", sa.Text(), nullable=False),
        sa.Column("tries", sa.Integer(), nullable=False),
        sa.Column("next_try_at", sa.Double(), nullable=False),
        sa.Column("created_at", sa.Double(), nullable=False),
        sa.ForeignKeyConstraint(["webhook_id"], ["webhooks.id"], ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id"),
    )
    op.create_index(op.f("ix_deliveries_webhook_id"), "deliveries", ["webhook_id"], unique=False)
    op.create_index(op.f("ix_deliveries_next_try_at"), "deliveries", ["next_try_at"], unique=False)
