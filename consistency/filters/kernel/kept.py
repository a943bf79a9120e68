"""Compiled code on disk: a list of digests beside it, so that nothing is loaded that is not what was kept.

Code that was damaged may crash the process that loads it, so that loading it cannot be tried.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

MARK = "compiled"  # the list, a file beside what is kept
LOCK = ".lock"


def mark(folder: Path) -> None:
    """List the files that a folder keeps; one that cannot be written keeps nothing."""
    try:
        (folder / MARK).write_text(json.dumps(_digests(folder)), encoding="utf-8")
    except OSError:
        return


def is_whole(folder: Path) -> bool:
    """Whether a folder keeps something, and just what it listed."""
    try:
        text = (folder / MARK).read_text(encoding="utf-8")
        digests = _digests(folder)
        return bool(digests) and json.dumps(digests) == text
    except (OSError, ValueError):
        return False


def is_damaged(folder: Path) -> bool:
    """Whether a folder was once whole and is so no more."""
    return (folder / MARK).exists() and not is_whole(folder)


def clear(folder: Path) -> bool:
    """Remove what is not whole; False where it cannot be removed."""
    try:
        for path in folder.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            elif path.name != LOCK:
                path.unlink()
    except FileNotFoundError:
        return True
    except OSError:
        return False
    return True


def _digests(folder: Path) -> dict[str, str]:
    """SHA-256 of each file by its place in the folder; raises OSError."""
    files = sorted(path for path in folder.rglob("*") if not path.is_dir() and path.name not in (MARK, LOCK))
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
