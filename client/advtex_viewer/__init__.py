"""What shows a model in 3D in a browser: scripts (ES modules), a style, and model-viewer.

The server's page serves these files, and the engine puts them beside a result, for its page that opens from disk.
Nothing but files: they ask the page for the addresses of a result's files, and know neither the API nor the engine.
"""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).parent
