"""Texture optimization: torch, usable alone, knows no HTTP and no queue."""
