"""How kernels are compiled: as one program, with IEEE division, without the GIL, and kept on disk by content.

Numba optimises each function together with all that it calls, makes machine code of it, and does so again for each of
its callers. Nothing but the kernel calls the functions of a kernel, so that inside :func:`one_program` they are lowered
only, and linked where the kernel is finished. This touches the inside of Numba: other versions than ``TESTED`` compile
as Numba does, with the same numbers.

The key covers the bytecode of every function that the kernel reaches, the constants that those read from any module,
and what compiles them. It does not cover paths, times, comments, or the text of docstrings. Numba compiles bytecode, so
bytecode is compared, not a file that may have been edited since it was imported.

Code that was damaged may crash the process that loads it, so that loading it cannot be tried; and code is run, so that
only what this user or root has written is loaded.
"""

from __future__ import annotations

import gc
import hashlib
import os
import pickle
import stat
import sys
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from enum import Enum
from functools import cache
from graphlib import TopologicalSorter
from importlib import metadata
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple

import numba
import numpy as np
from filelock import FileLock
from numba.core import codegen, compiler_lock, config, dispatcher, serialize, targetconfig, types
from numba.core.compiler import CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import cpu_target
from numba.core.types import functions
from numba.extending import intrinsic, register_jitable

from consistency.bench.filters.compiler.dispatch import BODIES, INNER, OPTIONS, PARTS, ROUTINES, Function
from consistency.bench.scenario import models
from consistency.referee.system import away_from_signals

_result: Any = CompileResult  # untyped
_typeof: Callable[[Any], Any] = numba.typeof
_signatures: dict[Any, tuple[Any, ...]] = {}
TESTED = ("0.61", "0.68")  # lowest and highest series of Numba in which this was tried
INNER_OPTIMISATION = 1  # level of the passes over a function by itself; the whole is optimised at Numba's level
_Library: Any = codegen.JITCodeLibrary
_config: Any = config  # untyped, like what follows
_lock: Any = compiler_lock
_Function: Any = functions.BaseFunction
_flags: Any = targetconfig.ConfigStack
_known: dict[Any, Any] = {}  # types of calls
VERSIONED = ("numba", "llvmlite", "numpy", "scipy")
FOREIGN = sys.stdlib_module_names | set(VERSIONED)  # covered by their versions
# decide how code is made
COMPILING = ("../kernel/linalg.py", "dispatch.py", "jit.py")
SETTINGS = ("OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "LLVM_REFPRUNE_PASS", "LLVM_REFPRUNE_FLAGS", "BOUNDSCHECK",
            "DEBUGINFO_DEFAULT", "ENABLE_AVX", "USING_SVML")  # fmt: skip
_SCALARS = (type(None), bool, int, float, complex, str, bytes)
_INTRINSIC: Any = type(intrinsic(lambda context: None))
MOST = 1 << 30  # bytes of a folder, some 500 kernels; those not used for longest go first
SUFFIX = ".kernel"
_DIGEST = hashlib.sha256().digest_size
_STALE = 86_400.0  # s, after which a file that a killed process was writing is removed


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
        is_ready = signature in self._entries or (is_shared and read_code(code_path(content.key)) is not None)
        return Outlook(content.key, is_ready, is_shared, content.size)

    def _content(self, signature: tuple[Any, ...]) -> Content:
        models.register_jitables()
        return Content(self.function, signature)

    def _made(self, signature: tuple[Any, ...]) -> Any:
        content = self._contents.get(signature) or self._content(signature)
        entry = numba.njit(**OPTIONS)(self.function)
        if content.unknown is not None:
            return self._compiled(entry, signature, content)
        path = code_path(content.key)
        if not self._load(entry, read_code(path, tell=True)):
            with one_at_a_time(path):
                if not self._load(entry, read_code(path)):
                    self._compiled(entry, signature, content)
                    result = entry.overloads[signature]
                    if not result.library.has_dynamic_globals and not result.lifted:  # no address of this process
                        write_code(path, serialize.dumps(result._reduce()))  # type: ignore[no-untyped-call]
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
