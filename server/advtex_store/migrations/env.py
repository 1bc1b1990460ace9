"""Run by alembic inside the transaction that `database.py` opened. The rule of the migrations is in `schema.py`."""

from __future__ import annotations

from alembic import context

from advtex_store.models import Base

context.configure(
    connection=context.config.attributes["connection"], target_metadata=Base.metadata, render_as_batch=True
)
with context.begin_transaction():
    context.run_migrations()
