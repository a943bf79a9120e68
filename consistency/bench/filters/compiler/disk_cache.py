"""Compiled code on disk: one file for each content, with a digest, so that nothing is loaded that is not what was kept.

Code that was damaged may crash the process that loads it, so that loading it cannot be tried; and code is run, so that
only what this user or root has written is loaded.
"""

from __future__ import annotations

import hashlib
import os
import stat
import sys
import tempfile
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import cache
from pathlib import Path
from typing import Any

from filelock import FileLock

MOST = 1 << 30  # bytes of a folder, some 500 kernels; those not used for longest go first
SUFFIX = ".kernel"
_DIGEST = hashlib.sha256().digest_size
_STALE = 86_400.0  # s, after which a file that a killed process was writing is removed


def folder() -> Path:
    """Where code is kept: NUMBA_CACHE_DIR, XDG_CACHE_HOME or ~/.cache, and filter-consistency in it."""
    base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "filter-consistency"


def code_path(key: str) -> Path:
    return folder() / f"{key}{SUFFIX}"


def read_code(path: Path, tell: bool = False) -> bytes | None:
    """What a file keeps; None where it is absent, damaged, or could have been written by somebody else.

    With ``tell``, what is wrong is said on stderr.
    """
    try:
        content = path.read_bytes() if is_ours(path.parent, path) else b""
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        refusal = f"{error.strerror}; code is compiled for this process"
    else:
        payload, refusal = content[_DIGEST:], ""
        if not content:
            refusal = "somebody else may write there; code is compiled for this process"
        elif hashlib.sha256(payload).digest() != content[:_DIGEST]:
            refusal = "compiled code is damaged there; it is compiled again"
    if refusal:
        if tell:
            _say(f"{path}: {refusal}")
        return None
    with suppress(OSError):  # used now
        os.utime(path)
    return payload


def write_code(path: Path, payload: bytes) -> bool:
    """Keep this, whole or not at all; False where the folder does not take it, which is said once."""
    try:
        _make(path.parent)
        if not is_ours(path.parent):
            return False
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".", delete=False) as file:
            try:
                file.write(hashlib.sha256(payload).digest() + payload)
                file.close()
                Path(file.name).replace(path)
            except BaseException:
                Path(file.name).unlink(missing_ok=True)
                raise
        prune(path.parent)
    except OSError as error:
        _say(f"{path.parent}: {error.strerror}; compiled code is not kept, name another folder by NUMBA_CACHE_DIR")
        return False
    return True


def folder_fault() -> str:
    """Why the folder takes no compiled code; empty where it does, and then it is there."""
    where = folder()
    try:
        _make(where)
        if not is_ours(where):
            return "somebody else may write there"
        with tempfile.TemporaryFile(dir=where):
            return ""
    except OSError as error:
        return error.strerror or str(error)


def one_at_a_time(path: Path) -> AbstractContextManager[Any]:
    """Lock of a file that is about to be written; none where the folder takes no lock."""
    try:
        _make(path.parent)
        lock = path.with_suffix(".lock")
        lock.touch()
        return FileLock(lock)
    except OSError:
        return nullcontext()


def prune(where: Path, most: int = MOST) -> None:
    """Remove what was never finished, and of more than ``most`` bytes the files not used for longest."""
    files = [(path, path.stat()) for path in where.iterdir() if path.is_file()]
    newest = max((status.st_mtime for _, status in files), default=0.0)
    for path, status in files:
        if path.name.startswith(".") and status.st_mtime < newest - _STALE:
            path.unlink(missing_ok=True)
    total = 0
    for path, status in sorted(files, key=lambda entry: -entry[1].st_mtime):
        total += status.st_size if path.suffix == SUFFIX else 0
        if total > most and path.suffix == SUFFIX:
            path.unlink(missing_ok=True)


def _make(where: Path) -> None:
    where.parent.mkdir(parents=True, exist_ok=True)
    where.mkdir(mode=0o700, exist_ok=True)


def is_ours(*paths: Path) -> bool:
    """Whether this user or root owns all of them and nobody else may write there."""
    if not hasattr(os, "getuid"):
        return True
    return all(
        status.st_uid in (0, os.getuid()) and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
        for status in map(Path.stat, paths)
    )


@cache
def _say(sentence: str) -> None:
    """Once in a process."""
    print(f"consistency: {sentence}", file=sys.stderr)
