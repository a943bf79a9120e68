"""Files that appear whole or not at all, calls that no signal disturbs, and processes that end with their parent.

Standard library only.
"""

from __future__ import annotations

import ctypes
import errno
import glob
import os
import platform
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

FULL = {errno.ENOSPC, errno.EFBIG, errno.EIO, getattr(errno, "EDQUOT", errno.ENOSPC)}  # a disk, a quota, a limit
PARTIAL = ".partial"  # at the end of the name of what is being written
Result = TypeVar("Result")
IS_LINUX = sys.platform == "linux"
AT_STOP: list[Callable[[], None]] = []  # what is to be ended before a signal ends this process
WRITERS = 3  # times that a folder is removed, as a thread may be writing into it
PR_SET_PDEATHSIG = 1  # linux/prctl.h


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


def remove_at_stop(folder: Path) -> Callable[[], None]:
    """Have a half-written folder removed where a signal ends this process; return what ``AT_STOP`` has for it."""

    def remove() -> None:
        for _ in range(WRITERS):
            shutil.rmtree(folder, ignore_errors=True)

    AT_STOP.append(remove)
    return remove


def away_from_signals(call: Callable[..., Result], *args: Any) -> Result:
    """Return ``call(*args)``, which a thread does while the main one waits; KeyboardInterrupt comes after its end.

    Python runs handlers of signals in the main thread. One that raises where Numba or pyarrow turn their values into
    Python's meets code that expects no exception, and Python crashes.
    """
    if threading.current_thread() is not threading.main_thread():
        return call(*args)
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as pool:
        pool.submit(int).result()  # a pool waits at its end for the threads that it knows to have begun
        return pool.submit(call, *args).result()


def link_to_parent(context: Any) -> tuple[int, Any]:
    """Return what a worker gives to :func:`end_with_parent`, which ``context`` of multiprocessing starts.

    These are the number of this process and the end of a pipe into which nobody writes. This process alone has its
    other end, so that the pipe is closed when this process ends.
    """
    return os.getpid(), _pipe(context)[0]


@cache
def _pipe(context: Any) -> tuple[Any, Any]:
    ends: tuple[Any, Any] = context.Pipe(duplex=False)
    return ends


def end_with_parent(parent: int, alive: Any) -> None:
    """Have the system kill this worker when its parent ends; ``alive`` is its end of the pipe.

    On Linux the signal comes when the *thread* ends that started the worker, so start workers in one that lives as
    long as they are to.
    """
    if not IS_LINUX:
        threading.Thread(target=_wait_for_the_end, args=(alive,), daemon=True).start()
        return
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it had ended before
        os._exit(1)


def _wait_for_the_end(alive: Any) -> None:
    with suppress(OSError, EOFError):
        alive.recv_bytes()
    os._exit(1)
