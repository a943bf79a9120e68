"""Kernel functions chosen at compile time by the types of their parts, and records of arrays by reference.

A part is a small NamedTuple: a motion, a sensor, an update ... Its type chooses the code and its fields carry its
parameters. ``generic`` declares a function, ``implement`` gives it a body for some types of parts. A kernel that
calls a generic function is compiled with the one body that fits, so that a filter compiles what it uses and
nothing is decided at run time.

Bodies and parts stand at module level. Numba names a closure by a counter of the process, and kernels that
different processes have cached would be linked to each other's functions; two parts of one name would share code
in the same way, so ``part`` refuses the second.

Numba passes a NamedTuple by value, seven numbers for each array in it, and counts a reference to each array that a
function touches; in steps of some microseconds both take longer than the arithmetic. Such a record is a
pointer to the record in the frame of the function that passes it. Its arrays do not own their memory, so that
function keeps the record alive with :func:`keep` until nobody uses them any more.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, intrinsic, lower_getattr_generic, models, overload, register_model

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
INNER: dict[str, Any] = OPTIONS | {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_overload: Callable[..., Any] = overload
Function = TypeVar("Function", bound=Callable[..., Any])
Part = TypeVar("Part", bound=type)
Bodies = dict[type | None, Callable[..., Any]]
PARTS: dict[str, type] = {}
_needs: dict[type, dict[str, frozenset[str]]] = {}
BODIES: dict[Any, Bodies] = {}  # of each generic function by the type that chooses them, None for the default
_named_bodies: dict[str, Callable[..., Any]] = {}
ROUTINES: set[Any] = set()  # plain Python around the functions that kernels are made of
Record = TypeVar("Record")
_intrinsic: Callable[[Any], Any] = intrinsic
_llvm: Any = cgutils  # untyped


def part(**needs: str) -> Callable[[Part], Part]:
    """Decorator of a part: a NamedTuple at module level, with a name that no other part has.

    Parameters
    ----------
    needs : names of the parts that it can be combined with, by role and separated by blanks, as in
        ``landmark="WorldPoint"``; any where a role is left out.

    Raises
    ------
    TypeError
        Not a NamedTuple at module level, or the name is taken.
    """

    def register(cls: Part) -> Part:
        if not (issubclass(cls, tuple) and hasattr(cls, "_fields")) or "<locals>" in cls.__qualname__:
            raise TypeError(f"part '{cls.__qualname__}' must be a NamedTuple at module level")
        if cls.__name__ in PARTS:
            other = PARTS[cls.__name__].__module__
            raise TypeError(
                f"a part named '{cls.__name__}' is there already, in {other}; two would share compiled code"
            )
        PARTS[cls.__name__] = cls
        _needs[cls] = {role: frozenset(names.split()) for role, names in needs.items()}
        return cls

    return register


def generic(*, default: bool = False) -> Callable[[Function], Function]:
    """Decorator of a function whose body is chosen by the type of its first argument.

    Its signature and docstring say what every implementation does. Its own body is that of parts that have none, if it
    is a ``default``, and is never run if not.
    """

    def declare(stub: Function) -> Function:
        bodies: Bodies = {None: stub} if default else {}

        @wraps(stub)
        def call(*args: Any) -> Any:
            return _body(stub, bodies, type(args[0]))(*args)

        def choose(*args: Any) -> Any:
            return _body(stub, bodies, getattr(args[0], "instance_class", None))

        _overload(call, strict=False, jit_options=INNER)(choose)
        BODIES[call] = bodies
        chosen: Any = call
        return chosen

    return declare


def implement(function: Callable[..., Any], cls: type) -> Callable[[Function], Function]:
    """Decorator of the body of a generic ``function`` for parts of this type; one body may serve several.

    Raises
    ------
    TypeError
        The body is a closure, its name is taken, or there is a body for this type.
    """

    def register(body: Function) -> Function:
        name = f"{body.__module__}.{body.__qualname__}"
        if "<locals>" in name or _named_bodies.get(name, body) is not body:
            raise TypeError(f"kernel function '{name}' must stand at module level under a name of its own")
        if cls in BODIES[function]:
            raise TypeError(f"'{function.__name__}' has a body for {cls.__name__} already")
        _named_bodies[name] = body
        BODIES[function][cls] = body
        return body

    return register


def routine(function: Function) -> Function:
    """Decorator of a function that calls machine code, such as BLAS: compiled where Python calls it, too."""
    compiled: Any = njit(**OPTIONS)(function)

    @wraps(function)
    def call(*args: Any) -> Any:
        return compiled(*args)

    def choose(*args: Any) -> Any:
        return function

    _overload(call, strict=False, jit_options=INNER)(choose)
    ROUTINES.add(call)
    called: Any = call
    return called


def require_fitting(parts: Any) -> None:
    """Refuse a combination of ``parts``, a NamedTuple by role, that means nothing.

    Raises
    ------
    TypeError
        An unknown part, or two that do not go together.
    """
    for role, value in zip(parts._fields, parts, strict=True):
        cls = type(value)
        if PARTS.get(cls.__name__) is not cls:
            raise TypeError(f"{role}: '{cls.__name__}' is not a registered part")
        for other, names in _needs[cls].items():
            chosen = type(getattr(parts, other)).__name__
            if chosen not in names:
                raise TypeError(
                    f"{role} '{cls.__name__}' does not go with {other} '{chosen}', only with {', '.join(sorted(names))}"
                )


def fits(parts: Any) -> bool:
    """Whether :func:`require_fitting` lets ``parts`` pass."""
    try:
        require_fitting(parts)
    except TypeError:
        return False
    return True


def _body(stub: Any, bodies: Bodies, cls: Any) -> Callable[..., Any]:
    body = bodies.get(cls, bodies.get(None))
    if body is None:
        known = ", ".join(sorted(each.__name__ for each in bodies if each is not None)) or "none"
        raise TypeError(f"'{stub.__name__}' has no body for {getattr(cls, '__name__', cls)}; there are {known}")
    return body


class Reference(types.Type):
    """Pointer to a NamedTuple."""

    def __init__(self, record: Any) -> None:
        self.record = record
        super().__init__(name=f"Reference({record})")


@register_model(Reference)
class _ReferenceModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, ir.IntType(8).as_pointer())  # type: ignore[no-untyped-call]


@infer_getattr
class _ReferenceFields(AttributeTemplate):
    key = Reference

    def generic_resolve(self, reference: Any, field: str) -> Any:  # type: ignore[override]
        fields = reference.record.fields
        return reference.record.types[fields.index(field)] if field in fields else None


@lower_getattr_generic(Reference)  # type: ignore[no-untyped-call, untyped-decorator]
def _field(context: Any, builder: Any, reference: Any, pointer: Any, field: str) -> Any:
    kind = context.get_value_type(reference.record).as_pointer()
    place = reference.record.fields.index(field)
    return builder.load(_llvm.gep_inbounds(builder, builder.bitcast(pointer, kind), 0, place))


def _without_owner(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """The value with the owners of all arrays in it taken out."""
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        array.meminfo = _llvm.get_null_value(array.meminfo.type)
        array.parent = _llvm.get_null_value(array.parent.type)
        return array._getvalue()
    if isinstance(kind, types.BaseTuple):
        members: Any = kind
        for i, each in enumerate(members.types):
            value = builder.insert_value(
                value, _without_owner(context, builder, each, builder.extract_value(value, i)), i
            )
    return value


@_intrinsic
def _by_reference(_: Any, record: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        bare = _without_owner(context, builder, record, values[0])
        return builder.bitcast(_llvm.alloca_once_value(builder, bare), ir.IntType(8).as_pointer())

    return Reference(record)(record), generate


@_intrinsic
def _keep(_: Any, record: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return context.get_dummy_value()

    return types.void(record), generate


by_reference: Callable[[Record], Record] = _by_reference  # to a type checker the same type
keep: Callable[[Any], None] = _keep
