"""Results that were edited, as by one who means it."""

from __future__ import annotations

import json
from pathlib import Path


def content(folder: Path) -> dict[str, bytes]:
    """Bytes of the tables in a folder, by name."""
    return {path.name: path.read_bytes() for path in folder.glob("*.parquet")}


def accept_changes(folder: Path) -> None:
    """Take the digests of the tables out of the manifest."""
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text(encoding="utf-8"))
    manifest.pop("contents", None)
    path.write_text(json.dumps(manifest), encoding="utf-8")
