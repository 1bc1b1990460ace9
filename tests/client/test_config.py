"""Where address and key come from, and where keys never go."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from advtex_client import ConfigError, load_config
from advtex_client.config import embedded_file, user_file

LOCAL, CLOUD = "http://127.0.0.1:8000", "https://texture.example"


def write_toml(url: str | None = CLOUD, key: str | None = "toml") -> None:
    user_file().parent.mkdir(parents=True, exist_ok=True)
    lines = [f'url = "{url}"' if url else "", f'api_key = "{key}"' if key else ""]
    user_file().write_text("\n".join(lines))


def write_embedded(url: str = LOCAL, key: str = "embedded") -> None:
    embedded_file().parent.mkdir(parents=True, exist_ok=True)
    embedded_file().write_text(json.dumps({"url": url, "api_key": key}))


def found(url: str | None = None, key: str | None = None) -> tuple[str, str]:
    config = load_config(url, key)
    return config.url, config.api_key


def test_the_order_is_arguments_environment_file_embedded(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="advtex-server up"):
        load_config()
    write_embedded()
    assert found() == (LOCAL, "embedded")
    write_toml()
    assert found() == (CLOUD, "toml")
    monkeypatch.setenv("ADVTEX_URL", "http://env.example/")
    monkeypatch.setenv("ADVTEX_API_KEY", "env")
    assert found() == ("http://env.example", "env")
    assert found("http://flag.example", "flag") == ("http://flag.example", "flag")


def test_no_source_s_key_goes_to_another_source_s_server(monkeypatch: pytest.MonkeyPatch) -> None:
    write_embedded()
    write_toml()
    assert found("http://evil.example") == ("http://evil.example", "")
    assert found(CLOUD + "/") == (CLOUD, "toml")
    assert found(LOCAL) == (LOCAL, "embedded")
    monkeypatch.setenv("ADVTEX_URL", "http://env.example")
    monkeypatch.setenv("ADVTEX_API_KEY", "env")
    assert found("http://evil.example") == ("http://evil.example", "")


def test_a_key_without_an_address_fits_any(monkeypatch: pytest.MonkeyPatch) -> None:
    write_embedded()
    monkeypatch.setenv("ADVTEX_API_KEY", "env")
    assert found() == (LOCAL, "env")
    assert found("http://flag.example") == ("http://flag.example", "env")
    assert found(key="flag") == (LOCAL, "flag")


@pytest.mark.parametrize("url", ["server.example", "ftp://server.example", "http://", "http://[::1"])
def test_an_address_that_is_none_is_said(url: str) -> None:
    with pytest.raises(ConfigError, match="give something like http"):
        load_config(url)


@pytest.mark.parametrize("text", ["url = ", "url = 3\n", "\xff"])
def test_a_broken_file_is_named(text: str) -> None:
    user_file().parent.mkdir(parents=True, exist_ok=True)
    user_file().write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigError, match=r"config\.toml.*mend or remove it"):
        load_config()


def test_the_embedded_server_s_folder_follows_its_variable(tmp_path: Path) -> None:
    assert embedded_file() == tmp_path / "data" / "client.json"
