"""Types of calls, inferred once for all kernels of a process.

For each call in each function, and each time that what it is given becomes known, Numba asks all that is registered
for what is called: for ``a * b`` some thirty templates, of strings, lists and dates, before that of numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import targetconfig
from numba.core.types import functions

_Function: Any = functions.BaseFunction
_config: Any = targetconfig.ConfigStack
_known: dict[Any, Any] = {}


@contextmanager
def remembered_types() -> Iterator[None]:
    """While a kernel is compiled, and under the global lock of the compiler.

    A function has one type for arguments of the same types under the same rules for floating-point numbers. A call
    that has none is asked anew, so that its error says what Numba says.
    """
    infer = _Function.get_call_type

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        flags = _config.top_or_none()
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
