"""What a kernel is made of: the key of its compiled code, by content.

The key covers the bytecode of every function that the kernel reaches, the constants that those read from any module,
and what compiles them. It does not cover paths, times, comments, or the text of docstrings. Numba compiles bytecode, so
bytecode is compared, not a file that may have been edited since it was imported.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable, Mapping
from enum import Enum
from functools import cache
from importlib import metadata
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
from numba.core import config, dispatcher, types
from numba.core.registry import cpu_target
from numba.extending import intrinsic

from consistency.bench.filters.compiler.dispatch import BODIES, OPTIONS, PARTS, ROUTINES

VERSIONED = ("numba", "llvmlite", "numpy", "scipy")
FOREIGN = sys.stdlib_module_names | set(VERSIONED)  # covered by their versions
# decide how code is made
COMPILING = (
    "../kernel/blas.py",
    *(f"{name}.py" for name in ("content_key", "dispatch", "jit", "by_reference", "whole_program")),
)
SETTINGS = ("OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "LLVM_REFPRUNE_PASS", "LLVM_REFPRUNE_FLAGS", "BOUNDSCHECK",
            "DEBUGINFO_DEFAULT", "ENABLE_AVX", "USING_SVML")  # fmt: skip
_SCALARS = (type(None), bool, int, float, complex, str, bytes)
_INTRINSIC: Any = type(intrinsic(lambda context: None))


class Content:
    """Everything that a kernel reaches.

    Parameters
    ----------
    function : the kernel
    signature : types of its arguments

    ``dispatchers`` are qualified names of functions of Numba among it, which Python may call; ``unknown`` is the class
    of something that cannot be compared, so that the kernel must not be kept, or None.
    """

    def __init__(self, function: FunctionType, signature: tuple[Any, ...]) -> None:
        self.dispatchers: set[str] = set()
        self.unknown: str | None = None
        self._classes = {cls for kind in signature for cls in _classes(kind)}
        self._digest = hashlib.sha256(_versions().encode())
        self._seen: dict[int, Any] = {}
        self._note(str(signature))
        self._each(_compiling())
        self._add(function)

    @property
    def key(self) -> str:
        return self._digest.hexdigest()[:32]

    @property
    def size(self) -> int:
        """Bytes of bytecode of all functions that are compiled; those of libraries are left out."""
        seen = [each for each in self._seen.values() if isinstance(each, FunctionType)]
        own = [each for each in seen if not _is_foreign(each.__module__) and each not in BODIES]
        return sum(len(each.__code__.co_code) for each in own)

    def _add(self, value: Any, names: tuple[str, ...] = ()) -> None:
        """A value and what it reads; of a module, its attributes of these names."""
        if isinstance(value, _SCALARS):
            self._note(type(value).__name__, repr(value))
        elif isinstance(value, np.ndarray | np.generic):
            self._note("array", value.dtype.str, str(value.shape), value.tobytes().hex())
        elif isinstance(value, tuple | list):
            self._note(type(value).__qualname__, str(len(value)))
            self._each(value)
        elif isinstance(value, frozenset | set):
            self._note("set", *sorted(map(repr, value)))
        elif isinstance(value, Mapping):
            self._each(value.items())
        elif isinstance(value, CodeType):
            self._code(value)
        elif isinstance(value, ModuleType):
            self._module(value, names)
        elif id(value) in self._seen:
            self._note("again", getattr(value, "__qualname__", ""))
        else:
            self._seen[id(value)] = value
            self._object(value)

    def _object(self, value: Any) -> None:
        if isinstance(value, FunctionType):
            self._function(value)
        elif isinstance(value, dispatcher.Dispatcher):
            self.dispatchers.add(value.py_func.__qualname__)
            self._each((value.py_func, sorted((k, repr(v)) for k, v in value.targetoptions.items())))
        elif isinstance(value, _INTRINSIC):
            self._add(value._defn)
        elif isinstance(value, types.Type):
            self._note("type", str(value))
        elif isinstance(value, type):
            self._class(value)
        elif _is_foreign(getattr(value, "__module__", None) or type(value).__module__):
            self._note("foreign", type(value).__qualname__, getattr(value, "__qualname__", ""))
        else:
            self.unknown = self.unknown or f"{type(value).__module__}.{type(value).__qualname__}"

    def _function(self, function: FunctionType) -> None:
        self._note("function", function.__module__, function.__qualname__)
        if _is_foreign(function.__module__):
            return
        bodies = BODIES.get(function)
        if bodies is not None:  # those that this kernel cannot choose are left out
            chosen = [
                (k, v) for k, v in bodies.items() if k is None or k in self._classes or PARTS.get(k.__name__) is not k
            ]
            self._each(sorted(chosen, key=lambda item: getattr(item[0], "__qualname__", "")))
            return
        if function in ROUTINES:  # Python alone calls the wrapper
            function = function.__wrapped__  # type: ignore[attr-defined]
        code = function.__code__
        self._each((code, function.__defaults__, function.__kwdefaults__))
        self._each(cell.cell_contents for cell in function.__closure__ or ())
        names = _names(code)
        for name in sorted(set(names) & function.__globals__.keys()):
            self._note("global", name)
            self._add(function.__globals__[name], names)

    def _code(self, code: CodeType) -> None:
        """All but places in files and the docstring, which is the first constant."""
        constants = code.co_consts
        if constants and isinstance(constants[0], str):
            constants = constants[1:]
        self._note("code", code.co_code.hex(), str((code.co_flags, code.co_argcount, code.co_kwonlyargcount)))
        self._each((code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars, constants))

    def _class(self, cls: type) -> None:
        self._note("class", cls.__module__, cls.__qualname__)
        if not _is_foreign(cls.__module__):
            self._each((getattr(cls, "_fields", ()), getattr(cls, "_field_defaults", {})))
            own = vars(cls).items()
            self._each(sorted((k, repr(v)) for k, v in own if isinstance(v, (*_SCALARS, Enum)) and k[:2] != "__"))

    def _module(self, module: ModuleType, names: tuple[str, ...]) -> None:
        self._note("module", module.__name__)
        for name in () if _is_foreign(module.__name__) else sorted({name for name in names if hasattr(module, name)}):
            self._note("attribute", name)
            self._add(getattr(module, name), names)

    def _each(self, values: Iterable[Any]) -> None:
        for value in values:
            self._add(value)

    def _note(self, *texts: str) -> None:
        for text in texts:
            data = text.encode()
            self._digest.update(len(data).to_bytes(8, "little") + data)


def _classes(kind: Any) -> Iterable[type]:
    """Classes of the records in a type of Numba."""
    if hasattr(kind, "instance_class"):
        yield kind.instance_class
    for each in getattr(kind, "types", ()):
        yield from _classes(each)


def _names(code: CodeType) -> tuple[str, ...]:
    """Names of globals and attributes that a function reads, in functions inside it too."""
    inside = [name for each in code.co_consts if isinstance(each, CodeType) for name in _names(each)]
    return (*code.co_names, *inside)


def _is_foreign(module: str | None) -> bool:
    return module is not None and module.split(".")[0] in FOREIGN


@cache
def _versions() -> str:
    """What compiles: versions, settings, processor."""
    versions = [f"{name} {metadata.version(name)}" for name in VERSIONED]
    settings = [f"{name}={getattr(config, name, None)}" for name in SETTINGS]
    cpu_target.target_context.refresh()
    processor = cpu_target.target_context.codegen().magic_tuple()
    return f"{sys.implementation.cache_tag} {versions} {settings} {processor} {OPTIONS}"


@cache
def _compiling() -> tuple[CodeType, ...]:
    """Code of the modules that decide how kernels are compiled."""
    return tuple(compile((Path(__file__).parent / name).read_bytes(), name, "exec") for name in COMPILING)
