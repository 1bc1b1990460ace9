"""What both clients do to a request before it is sent."""

from __future__ import annotations

from typing import Any

import httpx

from advtex_client._calls import Call
from advtex_client.config import ClientConfig
from advtex_client.errors import IntegrityError
from advtex_contract.jobs import ANY_STATE_HEADER, ResultFile
from advtex_scan.version import product_version

LIMITS = httpx.Limits(max_connections=10)
TIMEOUT = httpx.Timeout(60.0, connect=10.0)
UPLOAD_TIMEOUT = httpx.Timeout(60.0, connect=10.0, read=600.0)  # the answer comes after the bytes are hashed and synced


def base_headers(config: ClientConfig) -> dict[str, str]:
    headers = {"User-Agent": f"advtex-client/{product_version()}", ANY_STATE_HEADER: "yes"}
    return headers | {"Authorization": f"Bearer {config.api_key}"} if config.api_key else headers


def build(http: httpx.Client | httpx.AsyncClient, call: Call[Any]) -> httpx.Request:
    if call.body is None:
        return http.build_request(call.method, call.path, json=call.json, params=call.params, headers=call.headers)
    bare = http.build_request(call.method, call.path, headers=call.headers, timeout=UPLOAD_TIMEOUT)
    return httpx.Request(bare.method, bare.url, headers=bare.headers, stream=call.body, extensions=bare.extensions)


def result_url(base: str, file: ResultFile) -> str:
    """Return the address of a result. It is always on the same server, whatever the answer says, so the key goes
    nowhere else; raises IntegrityError."""
    url = httpx.URL(base + "/").join(file.url)
    home = httpx.URL(base)
    if (url.scheme, url.host, url.port) != (home.scheme, home.host, home.port):
        raise IntegrityError(
            f"{file.name} is said to lie at {url}, which is not the server {base}; nothing was fetched"
        )
    return str(url)
