"""Where the server is and with which key: flags, environment, the user's file, the embedded server's file."""

from __future__ import annotations

import json
import os
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import platformdirs

from advtex_client.errors import ConfigError


@dataclass(frozen=True)
class ClientConfig:
    """The server's base URL without a trailing slash, its key (empty where it asks for none), and where each was
    found."""

    url: str
    api_key: str
    url_from: str = ""
    api_key_from: str = ""


def user_file() -> Path:
    """Return the path of the user's own TOML file with `url` and `api_key`."""
    return platformdirs.user_config_path("advtex") / "config.toml"


def embedded_file() -> Path:
    """Return the path of what `advtex-server up` writes for clients on the same machine."""
    folder = os.environ.get("ADVTEX_DATA_DIR")
    return (Path(folder) if folder else platformdirs.user_data_path("advtex")) / "client.json"


def load_config(url: str | None = None, api_key: str | None = None) -> ClientConfig:
    """Find the server: the first source that names one wins, and no source's key is sent to another one's server.

    Order: arguments, ADVTEX_URL and ADVTEX_API_KEY, the user's TOML file, the embedded server's `client.json`.
    A key from a source that names no server fits any. Raises ConfigError.
    """
    sources = {
        "the call": {"url": url, "api_key": api_key},
        "the environment": {"url": os.environ.get("ADVTEX_URL"), "api_key": os.environ.get("ADVTEX_API_KEY")},
        str(user_file()): _read(user_file()),
        str(embedded_file()): _read(embedded_file()),
    }
    base, base_from = next(((found["url"], name) for name, found in sources.items() if found["url"]), (None, ""))
    if base is None:
        raise ConfigError(
            f"no server is configured; pass --url, set ADVTEX_URL, write `url` and `api_key` to {user_file()}, "
            f"or start one on this machine with `advtex-server up` (looked for {embedded_file()})"
        )
    base = _normalized(base)
    for name, found in sources.items():
        if found["api_key"] and (not found["url"] or _normalized(found["url"]) == base):
            return ClientConfig(base, found["api_key"], base_from, name)
    return ClientConfig(base, "", base_from)


def _read(path: Path) -> dict[str, str | None]:
    """Read `url` and `api_key` of a TOML or JSON file; both are None where the file is absent. Raises ConfigError."""
    try:
        text = path.read_text(encoding="utf-8")
        data: Any = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except FileNotFoundError:
        return {"url": None, "api_key": None}
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {error}; mend or remove it") from error
    values = {name: data.get(name) if isinstance(data, dict) else None for name in ("url", "api_key")}
    for name, value in values.items():
        if value is not None and not isinstance(value, str):
            raise ConfigError(f"{path}: `{name}` must be a string; mend or remove it")
    return values


def _normalized(url: str) -> str:
    try:
        parsed = httpx.URL(url)
    except httpx.InvalidURL as error:
        raise ConfigError(f"{url!r} is no URL: {error}; give something like http://127.0.0.1:8000") from error
    if parsed.scheme not in ("http", "https") or not parsed.host:
        raise ConfigError(f"{url!r} is no http(s) URL; give something like http://127.0.0.1:8000")
    return str(parsed).rstrip("/")
