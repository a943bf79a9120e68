"""A kernel compiled as one program: what it calls is linked into it, then optimised and turned into machine code once.

Numba optimises each function together with all that it calls, makes machine code of it, and does so again for each of
its callers. Nothing but the kernel calls the functions of a kernel, so that inside :func:`one_program` they are lowered
only, and linked where the kernel is finished. This touches the inside of Numba: other versions than ``TESTED`` compile
as Numba does, with the same numbers.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from graphlib import TopologicalSorter
from typing import Any

import numba
from numba.core import codegen, compiler_lock, config, targetconfig
from numba.core.registry import cpu_target
from numba.core.types import functions

TESTED = ("0.61", "0.68")  # lowest and highest series of Numba in which this was tried
INNER_OPTIMISATION = 1  # level of the passes over a function by itself; the whole is optimised at Numba's level
_Library: Any = codegen.JITCodeLibrary
_config: Any = config  # untyped, like what follows
_lock: Any = compiler_lock
_Function: Any = functions.BaseFunction
_flags: Any = targetconfig.ConfigStack
_known: dict[Any, Any] = {}  # types of calls


def is_supported() -> bool:
    """Whether this version of Numba lies in the range that was tried."""
    low, high = (tuple(map(int, version.split("."))) for version in TESTED)
    return low <= tuple(map(int, numba.__version__.split(".")[:2])) <= high


class _Program(_Library):  # type: ignore[misc]
    """Library of the kernel, or of a function that Python may call, too: made as Numba does, of all parts at once."""

    _linking_libraries: list[Any]

    def finalize(self) -> None:
        self._linking_libraries = [_Bare(each) for each in _closure(self._linking_libraries)]
        super().finalize()


class _Bare:
    """A library as one link of a program: without the functions that it calls, which are linked beside it."""

    def __init__(self, library: Any) -> None:
        self._library = library
        self._reload_init: Any = getattr(library, "_reload_init", set())

    def _get_module_for_linking(self) -> Any:
        return _Library._get_module_for_linking(self._library)


class _Part(_Library):  # type: ignore[misc]
    """Library of a function that only kernels call: neither optimised as a whole nor turned into machine code."""

    _standalone: Any = None
    _reload_init: Any = frozenset()  # what Numba 0.61 does not have

    def _optimize_functions(self, module: Any) -> None:
        if not hasattr(self._codegen, "_pass_builder"):  # before Numba 0.62 the level was not to be chosen
            super()._optimize_functions(module)
            return
        module.data_layout = self._codegen._data_layout
        level = min(INNER_OPTIMISATION, _config.OPT)
        for function in module.functions:
            passes, builder = self._codegen._function_pass_manager(opt=level)
            passes.run(function, builder)

    def finalize(self) -> None:
        _lock.require_global_compiler_lock()
        self._raise_if_finalized()
        self._finalize_dynamic_globals()
        for library in _closure(self._linking_libraries):
            self._reload_init |= getattr(library, "_reload_init", set())
            self._dynamic_globals.extend(library._dynamic_globals)
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        self._ensure_finalized()
        return 0  # no machine code

    def _get_module_for_linking(self) -> Any:
        """With all that it calls, for a library that is compiled as Numba does."""
        if self._standalone is None:
            self._standalone = super()._get_module_for_linking().clone()
            for library in _closure(self._linking_libraries):
                self._standalone.link_in(_Bare(library)._get_module_for_linking(), preserve=True)
        return self._standalone


def _closure(libraries: Any) -> list[Any]:
    """The libraries and, where those are parts, what they call in turn; each once, callers first.

    LLVM drops a function that nothing refers to when it is linked.
    """
    graph: dict[Any, Any] = {}
    waiting = list(libraries)
    while waiting:
        library = waiting.pop()
        if library not in graph:
            graph[library] = list(library._linking_libraries) if isinstance(library, _Part) else []
            waiting.extend(graph[library])
    return list(TopologicalSorter(graph).static_order())[::-1]


@contextmanager
def remembered_types() -> Iterator[None]:
    """Types of calls are inferred once for all kernels of a process: while one is compiled, under the compiler's lock.

    For each call in each function, and each time that what it is given becomes known, Numba asks all that is registered
    for what is called: for ``a * b`` some thirty templates, of strings, lists and dates, before that of numbers.

    A function has one type for arguments of the same types under the same rules for floating-point numbers. A call
    that has none is asked again, so that its error says what Numba says.
    """
    infer = _Function.get_call_type

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        flags = _flags.top_or_none()
        if kws or flags is None:
            return infer(self, context, args, kws)
        key = (self, args, flags.error_model, frozenset(flags.fastmath.flags))
        if key not in _known:
            found = infer(self, context, args, kws)
            if not all(each.is_precise() for each in args):
                return found
            _known[key] = found
        return _known[key]

    _Function.get_call_type = get_call_type
    try:
        yield
    finally:
        _Function.get_call_type = infer


@contextmanager
def one_program(callable_too: Collection[str]) -> Iterator[None]:
    """While a kernel is compiled.

    Parameters
    ----------
    callable_too : qualified names of functions that have to be machine code by themselves, because Python calls them:
        the kernel, and dispatchers of Numba among what it calls
    """
    if not is_supported():
        yield
        return
    with _lock.global_compiler_lock:
        target: Any = cpu_target.target_context
        target.refresh()
        code, environments = target.codegen(), {}

        def library_class(codegen: Any, name: str, **options: Any) -> Any:
            return (_Program if name in callable_too else _Part)(codegen, name, **options)

        def set_later(name: str, environment: Any) -> None:
            """A part has no memory to write to before the program that holds it is finished."""
            environments[name] = environment
            for known in [each for each in environments if code._engine.is_symbol_defined(each)]:
                type(code).set_env(code, known, environments.pop(known))

        code._library_class, code.set_env = library_class, set_later
        try:
            with remembered_types():
                yield
        finally:
            del code._library_class, code.set_env
