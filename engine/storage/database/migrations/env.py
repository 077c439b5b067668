"""What Alembic runs to migrate; the connection comes from `engine.storage.database.schema`."""

from __future__ import annotations

from alembic import context

from engine.storage.database.models import Base

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=Base.metadata,
    # SQLite changes a table by copying it.
    render_as_batch=True,
    compare_type=True,
)
with context.begin_transaction():
    context.run_migrations()
