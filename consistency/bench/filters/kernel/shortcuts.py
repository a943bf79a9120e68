"""What Numba works out again and again while it compiles a kernel, found with less: the result is the same.

For every pass over every function Numba lists the variables of each instruction, and looks at all fields of what lies
there to do so. For every counted reference to a record it takes the record apart, down to the numbers in it, whose
references nobody counts; the instructions that do so are half of what a kernel is made of before it is optimised.
"""

from __future__ import annotations

import gc
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import ir
from numba.core.runtime import context

RARE = 100_000  # new objects after which Python looks for cycles; one function makes some ten thousand that stay
_Inst: Any = ir.Inst
_Runtime: Any = context.NRTContext
_VARIABLE: Any = ir.Var
_EXPRESSION: Any = ir.Expr
_plain: set[type] = set()  # classes of what holds no variable
_counted: dict[Any, bool] = {}


@contextmanager
def shortcuts() -> Iterator[None]:
    """While a kernel is compiled, and under the global lock of the compiler."""
    variables, meminfos, often = _Inst._rec_list_vars, _Runtime.get_meminfos, gc.get_threshold()
    _Inst._rec_list_vars, _Runtime.get_meminfos = _variables, _meminfos
    gc.set_threshold(max(RARE, often[0]), *often[1:])
    try:
        yield
    finally:
        _Inst._rec_list_vars, _Runtime.get_meminfos = variables, meminfos
        gc.set_threshold(*often)


def _variables(_: Any, value: Any) -> list[Any]:
    """Variables in a value of an instruction, as ``Inst._rec_list_vars`` lists them."""
    found: list[Any] = []
    _collect((value,), found)
    return found


def _collect(values: Iterable[Any], found: list[Any]) -> None:
    for value in values:
        cls = type(value)
        if cls in _plain:
            continue
        if cls is _VARIABLE:
            found.append(value)
        elif cls is _EXPRESSION:
            _collect(value._kws.values(), found)
        elif isinstance(value, _Inst):
            found.extend(value.list_vars())
        elif isinstance(value, list | tuple):
            _collect(value, found)
        elif isinstance(value, dict):
            _collect(value.values(), found)
        elif isinstance(value, _VARIABLE):
            found.append(value)
        else:
            _plain.add(cls)


def _meminfos(self: Any, builder: Any, kind: Any, value: Any) -> list[tuple[Any, Any]]:
    """Counted references in a value, as ``NRTContext.get_meminfos`` lists them; fields without any are skipped."""
    model = self._context.data_model_manager[kind]
    found = [(kind, model.get_nrt_meminfo(builder, value))] if model.has_nrt_meminfo() else []
    for field, getter in model.traverse(builder):
        if _is_counted(self._context.data_model_manager, field):
            found.extend(_meminfos(self, builder, field, getter(value)))
    return found


def _is_counted(models: Any, kind: Any) -> bool:
    """Whether a value of this type holds a counted reference."""
    if kind not in _counted:
        model = models[kind]
        _counted[kind] = model.has_nrt_meminfo() or any(_is_counted(models, field) for field, _ in model.traverse(None))
    return _counted[kind]
