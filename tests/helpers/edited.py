"""Results that were edited, as by one who means it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def content(folder: Path) -> dict[str, bytes]:
    """Bytes of the tables in a folder, by name."""
    return {path.name: path.read_bytes() for path in folder.glob("*.parquet")}


def accept_changes(folder: Path) -> None:
    """Take the digests of the tables out of the manifest."""
    change_manifest(folder, "contents")


def change_manifest(folder: Path, *without: str, **changes: Any) -> None:
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text(encoding="utf-8")) | changes
    kept = {key: value for key, value in manifest.items() if key not in without}
    path.write_text(json.dumps(kept), encoding="utf-8")
