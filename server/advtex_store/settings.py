"""Where the service keeps things. Every value is read from `ADVTEX_*` variables; the defaults suit one machine."""

from __future__ import annotations

from pathlib import Path

import platformdirs
from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict


class StoreSettings(BaseSettings):
    """Database, blobs and queue, as server and workers both see them.

    data_dir: the folder of everything that is not told otherwise; `client.json` and the Redis password lie there.
    database_url: `sqlite:///path` or `postgresql://user:password@host/name`.
    blob_url: `file:///folder` or `s3://bucket/prefix` (with the usual `AWS_*` variables, `AWS_ENDPOINT_URL` included).
    redis_url: without a password in it, the one in `redis_password_file` is used.
    """

    model_config = SettingsConfigDict(env_prefix="ADVTEX_", extra="ignore", frozen=True)

    data_dir: Path = Field(default_factory=lambda: platformdirs.user_data_path("advtex"))
    database_url: str = ""
    blob_url: str = ""
    redis_url: str = "redis://127.0.0.1:6379/0"
    redis_password_file: Path | None = None
    lease_seconds: float = Field(
        default=60.0, gt=0, description="a running attempt is given up this long after its last heartbeat"
    )
    retention_seconds: int = Field(default=30 * 86400, gt=0, description="how long finished jobs and uploads are kept")
    max_retention_seconds: int = Field(default=90 * 86400, gt=0, description="the most that a job may ask for")

    reference_roots: str = Field(
        default="", description="URLs (file://, s3://), separated by blanks, below which scans may be referred to"
    )

    @property
    def database(self) -> str:
        """The SQLAlchemy URL."""
        url = self.database_url or f"sqlite:///{self.data_dir.absolute() / 'advtex.db'}"
        for plain in ("postgresql://", "postgres://"):
            if url.startswith(plain):
                return "postgresql+psycopg://" + url.removeprefix(plain)
        return url

    @property
    def blobs(self) -> str:
        """The URL of the blob storage."""
        return self.blob_url or (self.data_dir.absolute() / "blobs").as_uri()

    @property
    def spool_dir(self) -> Path:
        """Local folder for bytes on their way to object storage."""
        return self.data_dir / "spool"

    def redis_password(self) -> str | None:
        """The password of the embedded Redis, None when the URL says it all."""
        if self.redis_password_file is None:
            return None
        return self.redis_password_file.read_text().strip()
