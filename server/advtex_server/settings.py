"""Settings of the server: those of the store and its own, all from `ADVTEX_*` variables."""

from __future__ import annotations

from pydantic import Field, IPvAnyNetwork

from advtex_store.settings import StoreSettings


class ServerSettings(StoreSettings):
    """Limits and rhythms. Bytes and seconds."""

    max_upload_bytes: int = Field(default=32 << 30, gt=0)
    disk_reserve_bytes: int = Field(default=1 << 30, ge=0, description="uploads that would leave less are refused")
    idle_seconds: float = Field(default=60.0, gt=0, description="an upload that sends nothing for so long is ended")
    max_body_bytes: int = Field(default=1 << 20, gt=0, description="of requests that are not uploads")
    dispatch_seconds: float = Field(default=1.0, gt=0, description="between looks at waiting jobs")
    reconcile_seconds: float = Field(default=10.0, gt=0, description="between looks at leases and old blobs")
    sweep_seconds: float = Field(default=3600.0, gt=0, description="between looks for blobs that no row refers to")
    queue_depth: int = Field(default=1, gt=0, description="attempts that wait in Redis, per worker")
    auth_failures_per_minute: int = Field(
        default=60,
        gt=0,
        description="wrong keys that one address may send to one server process; which proxies are believed about "
        "addresses is said by FORWARDED_ALLOW_IPS, uvicorn's own variable",
    )
    session_seconds: float = Field(default=7 * 86400, gt=0, description="a browser has to sign in again after this")
    webhook_allow_http: bool = Field(default=False, description="webhooks may go to http:// addresses")
    webhook_networks: tuple[IPvAnyNetwork, ...] = Field(
        default=(), description="networks that are not public and that webhooks may go to, as a JSON list"
    )
    metrics_port: int | None = Field(
        default=None, ge=1, le=65535, description="/metrics is served there, and nowhere else"
    )
    metrics_key: bool = Field(default=False, description="/metrics asks for a key with the scope admin")
    metrics_owners: int = Field(
        default=10, ge=0, description="owners named in metrics, which they are with one of the two above only"
    )
    shutdown_seconds: int = Field(default=5, gt=0, description="open requests get this long when the server stops")

    @property
    def metrics_guarded(self) -> bool:
        """Whether not everybody who reaches the API reads the metrics."""
        return self.metrics_key or self.metrics_port is not None
