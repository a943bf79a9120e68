"""A file appears whole or not at all; standard library only."""

from __future__ import annotations

import errno
import glob
import os
import platform
import tempfile
from collections.abc import Iterator
from pathlib import Path

FULL = {errno.ENOSPC, errno.EFBIG, errno.EIO, getattr(errno, "EDQUOT", errno.ENOSPC)}  # a disk, a quota, a limit
PARTIAL = ".partial"  # at the end of the name of what is being written


def write_whole(path: Path, content: bytes, mode: int | None = None) -> None:
    """Write beside ``path`` and rename; ``mode`` of the file, None for what the umask leaves. Raises OSError."""
    for left in left_beside(path, path.parent):
        left.unlink()
    handle, name = tempfile.mkstemp(PARTIAL, f"{_prefix(path)}{os.getpid()}.", path.parent)
    partial = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.chmod(0o666 & ~umask() if mode is None else mode)
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def umask() -> int:
    """Permissions that the user takes from what is written."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


def partial_folder(path: Path, above: Path) -> Path:
    """Make a folder in ``above`` for what is to stand at ``path``. Raises OSError."""
    return Path(tempfile.mkdtemp(PARTIAL, f"{_prefix(path)}{os.getpid()}.", above))


def left_beside(path: Path, above: Path) -> Iterator[Path]:
    """Yield what processes of this machine that were killed have left in ``above`` of what was to stand at ``path``."""
    for left in above.glob(f"{glob.escape(_prefix(path))}*{PARTIAL}"):
        process = left.name.removeprefix(_prefix(path)).partition(".")[0]
        if process.isdecimal() and not _lives(int(process)):
            yield left


def _prefix(path: Path) -> str:
    return f".{path.name}.{platform.node()}-"


def _lives(process: int) -> bool:
    if os.name == "nt":  # where the question would end the process
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def make_durable(path: Path) -> None:
    """Bring a file, or the names in a folder, to disk, so that a power cut does not take them. Raises OSError."""
    if os.name == "nt":  # what is only read cannot be synchronised there
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
