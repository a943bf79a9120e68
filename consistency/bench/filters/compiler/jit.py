"""How kernels are compiled: nogil, IEEE division, as one program, and kept by content."""

from __future__ import annotations

import gc
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numba
import numpy as np
from numba.core import serialize
from numba.core.compiler import CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.extending import register_jitable

from consistency.bench.filters.compiler import disk_cache
from consistency.bench.filters.compiler.content_key import Content
from consistency.bench.filters.compiler.dispatch import INNER, OPTIONS, Function
from consistency.bench.filters.compiler.whole_program import one_program
from consistency.bench.models import jitable
from consistency.referee.system.stopping import away_from_signals

_result: Any = CompileResult  # untyped
_typeof: Callable[[Any], Any] = numba.typeof
_signatures: dict[Any, tuple[Any, ...]] = {}


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


class Outlook(NamedTuple):
    """What a call of a kernel begins with."""

    key: str  # of what the kernel is made of
    is_ready: bool  # compiled in this process, or on disk
    is_shared: bool  # whether other processes can read what one has compiled
    size: int  # bytes of bytecode that it is compiled from


class Kernel:
    """A whole-trial entry: compiled on first use for each combination of parts, kept on disk for later processes.

    What was compiled of the same content is loaded, whoever compiled it and wherever its sources lay. One process
    compiles a content; those that waited for it read what it has kept. Nothing of this is done in the main thread.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function: Any = function
        self.loaded = 0  # signatures that this process has read from disk
        self._entries: dict[Any, Any] = {}
        self._contents: dict[Any, Content] = {}  # by signature, as far as somebody has asked

    def __call__(self, *args: Any) -> Any:
        return away_from_signals(self._run, *args)

    def compile(self, *args: Any) -> Callable[..., Any]:
        """The entry, compiled for these arguments or loaded from disk."""
        return away_from_signals(self._entry, *args)

    def _run(self, *args: Any) -> Any:
        return self._entry(*args)(*args)

    def _entry(self, *args: Any) -> Callable[..., Any]:
        signature = _signature(args)
        if signature not in self._entries:
            self._entries[signature] = self._made(signature)
        entry: Callable[..., Any] = self._entries[signature]
        return entry

    def is_ready(self, *args: Any) -> bool:
        """Whether a call with these arguments starts at once, or spends seconds on compiling first."""
        return _signature(args) in self._entries or self.outlook(*args).is_ready

    def outlook(self, *args: Any) -> Outlook:
        """What a call with these arguments begins with."""
        signature = _signature(args)
        if signature not in self._entries or signature not in self._contents:
            self._contents[signature] = self._content(signature)
        content = self._contents[signature]
        is_shared = content.unknown is None
        is_ready = signature in self._entries or (
            is_shared and disk_cache.read_code(disk_cache.code_path(content.key)) is not None
        )
        return Outlook(content.key, is_ready, is_shared, content.size)

    def _content(self, signature: tuple[Any, ...]) -> Content:
        jitable.register_jitables()
        return Content(self.function, signature)

    def _made(self, signature: tuple[Any, ...]) -> Any:
        content = self._contents.get(signature) or self._content(signature)
        entry = numba.njit(**OPTIONS)(self.function)
        if content.unknown is not None:
            return self._compiled(entry, signature, content)
        path = disk_cache.code_path(content.key)
        if not self._load(entry, disk_cache.read_code(path, tell=True)):
            with disk_cache.one_at_a_time(path):
                if not self._load(entry, disk_cache.read_code(path)):
                    self._compiled(entry, signature, content)
                    result = entry.overloads[signature]
                    if not result.library.has_dynamic_globals and not result.lifted:  # no address of this process
                        disk_cache.write_code(path, serialize.dumps(result._reduce()))  # type: ignore[no-untyped-call]
        return entry

    def _compiled(self, entry: Any, signature: tuple[Any, ...], content: Content) -> Any:
        names = {self.function.__qualname__, *content.dispatchers}
        with one_program(names), without_collection():
            entry.compile(signature)
        return entry

    def _load(self, entry: Any, payload: bytes | None) -> bool:
        """Give the entry the code that was kept, as Numba does with its own cache."""
        if payload is None:
            return False
        with global_compiler_lock:
            entry.targetctx.refresh()
            result = _result._rebuild(entry.targetctx, *pickle.loads(payload))
            entry.targetctx.insert_user_function(result.entry_point, result.fndesc, [result.library])
            entry.add_overload(result)
        self.loaded += 1
        return True


@contextmanager
def without_collection() -> Iterator[None]:
    """Turn garbage collection off for a while: most of what a compiler makes lives until it is done."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def _signature(args: tuple[Any, ...]) -> tuple[Any, ...]:
    """Types of the arguments; those of one kind are found once, which takes Numba as long as a short trial."""
    kind = _kind(args)
    if kind not in _signatures:
        _signatures[kind] = tuple(_typeof(arg) for arg in args)
    return _signatures[kind]


def _kind(value: Any) -> Any:
    """What the type of an argument depends on."""
    if isinstance(value, np.ndarray):
        return value.dtype, value.ndim, value.flags.c_contiguous, value.flags.f_contiguous, value.flags.writeable
    if isinstance(value, tuple):
        return type(value), *map(_kind, value)
    return type(value) if isinstance(value, bool | int | float | np.generic) else _typeof(value)
