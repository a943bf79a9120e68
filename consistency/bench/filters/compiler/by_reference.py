"""Records of arrays passed to kernel functions by reference, and without counting references.

Numba passes a NamedTuple by value, seven numbers for each array in it, and counts a reference to each array that a
function touches; in steps of some microseconds both take longer than the arithmetic. Such a record is a
pointer to the record in the frame of the function that passes it. Its arrays do not own their memory, so that
function keeps the record alive with :func:`keep` until nobody uses them any more.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, intrinsic, lower_getattr_generic, models, register_model

Record = TypeVar("Record")
_intrinsic: Callable[[Any], Any] = intrinsic
_llvm: Any = cgutils  # untyped


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
