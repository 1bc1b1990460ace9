"""The product's version. pyproject.toml states it; whatever else says it asks here, or is compared in a test."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def product_version() -> str:
    """The version of advtex that is installed; "0" where the packages lie on the path without being installed."""
    try:
        return version("advtex")
    except PackageNotFoundError:
        return "0"
