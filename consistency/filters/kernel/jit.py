"""How kernels are compiled: nogil, IEEE division, and a cache that no edited source can outlive."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from pathlib import Path
from typing import Any

import numba
from filelock import FileLock
from numba.extending import register_jitable

from consistency.filters.kernel.apart import apart
from consistency.filters.kernel.dispatch import INNER, OPTIONS, PACKAGE, Function, outside_files
from consistency.filters.kernel.kept import LOCK, clear, is_damaged, is_whole, mark


def inner(function: Function) -> Function:
    """Decorator of a function that kernels call; Python calls it as the plain function that it is.

    Raises
    ------
    TypeError
        The function is a closure.
    """
    if "<locals>" in function.__qualname__:
        raise TypeError(f"kernel function '{function.__qualname__}' must stand at module level")
    register_jitable(**INNER)(function)
    return function


def routine(function: Function) -> Function:
    """Decorator of a function that calls machine code, such as BLAS: compiled where Python calls it, too."""
    compiled: Any = numba.njit(**OPTIONS)(function)
    return compiled


def _digest(outside: Iterable[Path]) -> str:
    """Numba checks only the file of the cached entry; the key must cover all that it calls.

    It also keeps entries by path and time of that file, so another checkout of the same sources has another key.
    """
    digest = hashlib.sha256(f"{numba.__version__} {PACKAGE}".encode())
    sources = [*PACKAGE.glob("models/*.py"), *PACKAGE.glob("filters/**/*.py")]
    for path in [*sorted(sources), *outside]:
        digest.update(path.read_bytes() + str(path.stat().st_mtime_ns).encode())
    return digest.hexdigest()[:16]


@cache
def _cache_folder(outside: tuple[Path, ...]) -> Path:
    base = os.environ.get("NUMBA_CACHE_DIR")
    if not base:
        base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "filter-consistency" / _digest(outside)


class Kernel:
    """A whole-trial entry: compiled on first use for each combination of parts, kept on disk for later processes.

    Each signature has a folder of its own in the cache, named by the sources too of parts from outside the package
    (of a test, or of a user). One process compiles a signature; those that waited for it read what it has kept.
    Nothing of this is done in the main thread, see :mod:`consistency.filters.kernel.apart`; where that is told to end,
    ``stop`` is called.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self._entries: dict[Any, tuple[Any, Path]] = {}

    def __call__(self, *args: Any, stop: Callable[[], None] = lambda: None) -> Any:
        return apart(lambda: self._compiled(*args)(*args), stop=stop)

    def compile(self, *args: Any) -> Callable[..., Any]:
        """The entry, compiled for these arguments or loaded from disk."""
        return apart(self._compiled, *args)

    def _compiled(self, *args: Any) -> Callable[..., Any]:
        signature = _signature(args)
        entry, folder = self._entry(signature)
        if not entry.overloads:
            with _one_at_a_time(folder):
                if is_whole(folder):
                    entry.compile(signature)
                else:
                    entry = self._anew(signature)
        compiled: Callable[..., Any] = entry
        return compiled

    def is_ready(self, *args: Any) -> bool:
        """Whether a call with these arguments starts at once, or spends seconds on compiling first."""
        entry, folder = self._entry(_signature(args))
        return bool(entry.overloads) or is_whole(folder)

    @property
    def signatures(self) -> list[Any]:
        """Signatures compiled or loaded in this process."""
        return [signature for entry, _ in self._entries.values() for signature in entry.signatures]

    @property
    def loaded(self) -> int:
        """How many signatures this process has read from disk."""
        return sum(sum(entry.stats.cache_hits.values()) for entry, _ in self._entries.values())

    def _anew(self, signature: tuple[Any, ...]) -> Any:
        """The entry, compiled whatever the folder keeps, and kept where the folder takes it."""
        entry, folder = self._entry(signature)
        if is_damaged(folder):
            print(f"consistency: {folder}: compiled code is damaged there; it is compiled anew", file=sys.stderr)
        removed = clear(folder)
        if not removed:
            entry = numba.njit(**OPTIONS)(self.function)
            self._entries[self._key(signature)] = entry, folder
        try:
            entry.compile(signature)
        except OSError:  # a full disk: the code serves this process
            if not entry.overloads:
                raise
        else:
            if removed:
                mark(folder)
        return entry

    def _key(self, signature: tuple[Any, ...]) -> tuple[Any, ...]:
        return signature, tuple(outside_files())

    def _entry(self, signature: tuple[Any, ...]) -> tuple[Any, Path]:
        key = self._key(signature)
        if key not in self._entries:
            name = hashlib.sha256(f"{self.function.__qualname__}{signature}".encode()).hexdigest()[:16]
            folder = _cache_folder(key[1]) / name
            self._entries[key] = _cached(self.function, folder), folder
        return self._entries[key]


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


def _one_at_a_time(folder: Path) -> AbstractContextManager[Any]:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / LOCK).open("ab"):
            return FileLock(folder / LOCK)
    except OSError:
        return nullcontext()
