"""The Python client and its command line."""

from advtex_client.async_client import AsyncClient
from advtex_client.client import Client
from advtex_client.config import ClientConfig, load_config
from advtex_client.errors import (
    ApiError,
    AuthError,
    BusyError,
    ClientError,
    ConfigError,
    ConflictError,
    IntegrityError,
    InvalidRequestError,
    JobFailedError,
    NetworkError,
    NotFoundError,
    ScanRejectedError,
    ServerError,
    WaitTimeoutError,
)

__all__ = [
    "ApiError",
    "AsyncClient",
    "AuthError",
    "BusyError",
    "Client",
    "ClientConfig",
    "ClientError",
    "ConfigError",
    "ConflictError",
    "IntegrityError",
    "InvalidRequestError",
    "JobFailedError",
    "NetworkError",
    "NotFoundError",
    "ScanRejectedError",
    "ServerError",
    "WaitTimeoutError",
    "load_config",
]
