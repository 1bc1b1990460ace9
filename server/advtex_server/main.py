"""`advtex-server`: run the service, manage its keys, ask how it is."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from sqlalchemy.exc import SQLAlchemyError

from advtex_options.flags import version_flag
from advtex_server.embedded import SetupError
from advtex_server.fleet import look_at_fleet
from advtex_server.health import checks
from advtex_server.serving import dispatch as run_dispatcher
from advtex_server.serving import serve as run_server
from advtex_server.serving import up as run_all
from advtex_server.settings import ServerSettings
from advtex_server.top import show
from advtex_store.accounts import SCOPES, Accounts
from advtex_store.consistency import Disagreement, disagreements
from advtex_store.database import Database, migrate_database, upgrade_database
from advtex_store.errors import RecordNotFound, SchemaRefused
from advtex_store.logs import configure_logs
from advtex_store.schema import revisions
from advtex_store.store import Store, open_store

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="The texturing service. Settings come from ADVTEX_* variables.",
)
keys = typer.Typer(no_args_is_help=True, help="API keys.")
app.add_typer(keys, name="keys")

NAMED = 5  # of each kind of what is wrong


@app.callback()
def advtex_server(
    _version: Annotated[bool, version_flag("advtex-server")] = False,
) -> None:
    """What all commands have in common."""


Host = Annotated[str, typer.Option(help="address to listen on")]
Port = Annotated[int, typer.Option(min=0, max=65535, help="0 takes a free one")]
MaxActiveJobs = Annotated[
    int | None, typer.Option(min=0, max=2**31 - 1, help="jobs of its owner that have not ended, at most")
]
MaxRunningJobs = Annotated[
    int | None, typer.Option(min=1, max=2**31 - 1, help="jobs of its owner that run at a time, at most")
]
MaxBytes = Annotated[int | None, typer.Option(min=0, max=2**63 - 1, help="bytes of its owner's uploads, at most")]


@app.command()
def up(
    host: Host = "127.0.0.1",
    port: Port = 8000,
    data_dir: Annotated[Path | None, typer.Option(help="where everything is kept")] = None,
) -> None:
    """Run everything on this machine: API, Redis, database and one worker."""
    configure_logs()
    settings = ServerSettings() if data_dir is None else ServerSettings(data_dir=data_dir)
    with _told(SetupError, SchemaRefused):
        run_all(settings, host, port)


@app.command()
def serve(
    host: Host = "0.0.0.0",  # noqa: S104  a server in a container
    port: Port = 8000,
    dispatch: Annotated[
        bool,
        typer.Option("--dispatch/--no-dispatch", help="whether it dispatches too, or `advtex-server dispatch` does"),
    ] = True,
) -> None:
    """Run the API alone; workers, Redis and database are elsewhere."""
    configure_logs()
    with _told(SetupError, SchemaRefused):
        run_server(ServerSettings(), host, port, dispatch=dispatch)


@app.command()
def dispatch() -> None:
    """Run what servers with --no-dispatch leave: hand out jobs, put right, check scans, deliver webhooks."""
    configure_logs()
    with _told(SchemaRefused):
        run_dispatcher(ServerSettings())


@app.command()
def doctor(
    repair: Annotated[bool, typer.Option("--repair", help="mend what rows and blobs disagree on, and say how")] = False,
) -> None:
    """Say what works and what does not, and where rows and blobs disagree. Exit code 1 if work cannot be accepted, 3 if
    they disagree on something that is not mended."""
    settings = ServerSettings()
    store = open_store(settings)
    found = checks(store, settings)
    for check in found:
        _say(check.ok, check.name, check.message)
    broken = any(not check.ok and check.essential for check in found)
    left = 0 if broken else _consistency(store, repair)
    store.close()
    if broken or left:
        raise typer.Exit(1 if broken else 3)


@app.command()
def top(
    seconds: Annotated[float, typer.Option(min=0.2, help="between two looks")] = 2.0,
    once: Annotated[bool, typer.Option("--once", help="one picture, of all workers, and no more")] = False,
) -> None:
    """Watch the fleet: workers and what they do, who waits, what the last day brought, what failed. Ctrl-C ends it."""
    store = open_store(ServerSettings())
    with suppress(KeyboardInterrupt), _told(SQLAlchemyError):
        show(lambda: look_at_fleet(store), seconds, Console(), once=once)
    store.close()


@app.command()
def migrate(
    to: Annotated[
        str | None, typer.Option(help="an earlier schema, for a rollback; what only later ones know is lost")
    ] = None,
) -> None:
    """Bring the database's schema up to date, as every server does when it starts, or down again."""
    newest = revisions()[-1]
    with _told(SchemaRefused, ValueError):
        before = migrate_database(ServerSettings().database, to or newest)
    typer.echo(f"the schema was {before or 'empty'} and is {to or newest}")


@keys.command("create")
def create_key(
    name: Annotated[str, typer.Argument(help="whose key it is, for your own list")] = "",
    owner: Annotated[str | None, typer.Option(help="keys of one owner see the same jobs")] = None,
    scope: Annotated[list[str] | None, typer.Option(help=f"{', '.join(SCOPES)}; can be given several times")] = None,
    days: Annotated[int | None, typer.Option(min=1, help="until the key expires")] = None,
    max_active_jobs: MaxActiveJobs = None,
    max_bytes: MaxBytes = None,
    max_running_jobs: MaxRunningJobs = None,
) -> None:
    """Make a key and print it: it cannot be shown again."""
    expires = None if days is None else (datetime.now(UTC) + timedelta(days=days)).timestamp()
    try:
        key = _accounts().create_key(
            name,
            owner=owner,
            scopes=scope or ("read", "write"),
            expires_at=expires,
            max_active_jobs=max_active_jobs,
            max_bytes=max_bytes,
            max_running_jobs=max_running_jobs,
        )
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
    typer.echo(key)


@keys.command("list")
def list_keys() -> None:
    """One JSON object per key, without secrets; with what its owner has of what is limited."""
    accounts = _accounts()
    for row in accounts.list_keys():
        usage = accounts.usage(row.owner)
        typer.echo(
            json.dumps(
                {
                    "id": row.id,
                    "name": row.name,
                    "owner": row.owner,
                    "scopes": row.scopes,
                    "active_jobs": usage.active_jobs,
                    "max_active_jobs": row.max_active_jobs,
                    "bytes": usage.bytes,
                    "max_bytes": row.max_bytes,
                    "max_running_jobs": row.max_running_jobs,
                    "created_at": row.created_at,
                    "expires_at": row.expires_at,
                    "revoked_at": row.revoked_at,
                }
            )
        )


@keys.command("revoke")
def revoke_key(key_id: str) -> None:
    """Refuse a key from now on. Give its id, the part between the two underscores."""
    with _told(RecordNotFound):
        _accounts().revoke_key(key_id)


@keys.command("rotate")
def rotate_key(
    key_id: str,
    keep_hours: Annotated[float, typer.Option(min=0, help="how long the old key goes on working")] = 0,
) -> None:
    """Replace a key by a new one that sees and may do the same, and print it."""
    with _told(RecordNotFound):
        typer.echo(_accounts().rotate_key(key_id, keep_hours * 3600))


@keys.command("limit")
def limit_key(
    key_id: str,
    max_active_jobs: MaxActiveJobs = None,
    max_bytes: MaxBytes = None,
    max_running_jobs: MaxRunningJobs = None,
) -> None:
    """Set all limits of a key; what is left out is not limited."""
    with _told(RecordNotFound):
        _accounts().set_quota(key_id, max_active_jobs, max_bytes, max_running_jobs)


def main() -> None:
    """Entry point."""
    app()


def _accounts() -> Accounts:
    settings = ServerSettings()
    with _told(SchemaRefused):
        upgrade_database(settings.database)
    return Accounts(Database(settings.database))


def _consistency(store: Store, repair: bool) -> int:
    """-> how much rows and blobs still disagree on"""
    kinds: dict[str, list[Disagreement]] = defaultdict(list)
    for one in disagreements(store):
        if repair and one.mend is not None:
            typer.echo(f"mend {one.kind} {one.item}: {one.message} -> {one.mend()}")
        else:
            kinds[one.kind].append(one)
    for kind, ones in kinds.items():
        told = [f"{one.item}: {one.message}" for one in ones[:NAMED]]
        more = f"; and {len(ones) - NAMED} more" if len(ones) > NAMED else ""
        remedy = "" if ones[0].mend is None else " (--repair mends it)"
        _say(False, kind, f"{len(ones)}{remedy}: {'; '.join(told)}{more}")
    if not kinds:
        _say(True, "rows and blobs", "")
    return sum(map(len, kinds.values()))


def _say(ok: bool, name: str, message: str) -> None:
    typer.echo(f"{'ok  ' if ok else 'FAIL'} {name}{': ' if message else ''}{message}")


@contextmanager
def _told(*errors: type[Exception]) -> Iterator[None]:
    """What these say, instead of their traceback; exit code 1."""
    try:
        yield
    except errors as error:
        typer.echo(f"advtex-server: {error}", err=True)
        raise typer.Exit(1) from None


if __name__ == "__main__":
    main()
