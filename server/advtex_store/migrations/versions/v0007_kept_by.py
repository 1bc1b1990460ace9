"""Which request made an upload's bytes durable."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("uploads", sa.Column("kept_by", sa.String(length=255), nullable=True))


def downgrade() -> None:
    op.drop_column("uploads", "kept_by")
