"""How kernels are compiled: nogil, IEEE division, and a cache that no edited source can outlive."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numba
from filelock import FileLock

from consistency.filters.kernel.dispatch import OPTIONS, PACKAGE, Function, outside_files


def inner(function: Function) -> Function:
    """Decorator of a function that other kernels call."""
    compiled: Any = numba.njit(**OPTIONS)(function)
    return compiled


def _digest(outside: Iterable[Path]) -> str:
    """Numba checks only the file of the cached entry; the key must cover all that it calls."""
    digest = hashlib.sha256(numba.__version__.encode())
    sources = [*PACKAGE.glob("models/*.py"), *PACKAGE.glob("filters/**/*.py")]
    for path in [*sorted(sources), *outside]:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder(outside: Iterable[Path]) -> Path:
    base = os.environ.get("NUMBA_CACHE_DIR")
    if not base:
        base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "filter-consistency" / _digest(outside)


class Kernel:
    """A whole-trial entry: compiled on first use for each combination of parts, kept on disk for later processes.

    Parts from outside the package (of a test, or of a user) have a folder of the cache of their own, keyed by
    their sources too. One process compiles at a time; those that waited for it read what it has kept.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self._entries: dict[tuple[Path, ...], tuple[Any, Path]] = {}

    def __call__(self, *args: Any) -> Any:
        return self.compile(*args)(*args)

    def compile(self, *args: Any) -> Callable[..., Any]:
        """The entry, compiled for these arguments or loaded from disk."""
        entry, folder = self._entry()
        signature = _signature(args)
        if signature not in entry.overloads:
            with _one_at_a_time(folder):
                entry.compile(signature)
                _mark(folder, signature)
        compiled: Callable[..., Any] = entry
        return compiled

    def is_ready(self, *args: Any) -> bool:
        """Whether a call with these arguments starts at once, or spends seconds on compiling first."""
        entry, folder = self._entry()
        signature = _signature(args)
        return signature in entry.overloads or _marker(folder, signature).exists()

    @property
    def signatures(self) -> list[Any]:
        """Signatures compiled or loaded in this process."""
        return [signature for entry, _ in self._entries.values() for signature in entry.signatures]

    def _entry(self) -> tuple[Any, Path]:
        outside = tuple(outside_files())
        if outside not in self._entries:
            folder = _cache_folder(outside)
            self._entries[outside] = _cached(self.function, folder), folder
        return self._entries[outside]


def _cached(function: Any, folder: Path) -> Any:
    config: Any = numba.config
    before, config.CACHE_DIR = config.CACHE_DIR, str(folder)
    try:
        return numba.njit(cache=True, **OPTIONS)(function)
    except RuntimeError:  # no folder can be written: compile in every process
        return numba.njit(**OPTIONS)(function)
    finally:
        config.CACHE_DIR = before


def _signature(args: tuple[Any, ...]) -> tuple[Any, ...]:
    typeof: Callable[[Any], Any] = numba.typeof
    return tuple(typeof(arg) for arg in args)


def _marker(folder: Path, signature: tuple[Any, ...]) -> Path:
    return folder / f"{hashlib.sha256(str(signature).encode()).hexdigest()[:16]}.compiled"


def _mark(folder: Path, signature: tuple[Any, ...]) -> None:
    if folder.is_dir() and os.access(folder, os.W_OK):
        _marker(folder, signature).touch()


def _one_at_a_time(folder: Path) -> AbstractContextManager[Any]:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ".lock").touch()
    except OSError:
        return nullcontext()
    return FileLock(folder / ".lock")
