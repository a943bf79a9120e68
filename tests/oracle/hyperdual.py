"""Second derivatives to the last digits by hyper-dual numbers, Fike & Alonso (2011): a + b e1 + c e2 + d e1 e2."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]


class HyperDual:
    """A number with its derivatives in two directions; the parts are arrays of any matching shapes."""

    def __init__(self, a: Any, b: Any = 0.0, c: Any = 0.0, d: Any = 0.0) -> None:
        self.parts = (a, b, c, d)

    def __add__(self, other: Any) -> HyperDual:
        return HyperDual(*(x + y for x, y in zip(self.parts, lifted(other).parts, strict=True)))

    def __neg__(self) -> HyperDual:
        return HyperDual(*(-x for x in self.parts))

    def __sub__(self, other: Any) -> HyperDual:
        return self + -lifted(other)

    def __rsub__(self, other: Any) -> HyperDual:
        return lifted(other) + -self

    def __mul__(self, other: Any) -> HyperDual:
        (a, b, c, d), (p, q, r, s) = self.parts, lifted(other).parts
        return HyperDual(a * p, a * q + b * p, a * r + c * p, a * s + b * r + c * q + d * p)

    def __truediv__(self, other: HyperDual) -> HyperDual:
        p = other.parts[0]
        return self * other.map(1.0 / p, -1.0 / p**2, 2.0 / p**3)

    __radd__, __rmul__ = __add__, __mul__

    def map(self, f: Any, first: Any, second: Any) -> HyperDual:
        """A function of the number with these derivatives at its value."""
        _, b, c, d = self.parts
        return HyperDual(f, first * b, first * c, first * d + second * b * c)

    def sin(self) -> HyperDual:
        s, c = np.sin(self.parts[0]), np.cos(self.parts[0])
        return self.map(s, c, -s)

    def cos(self) -> HyperDual:
        s, c = np.sin(self.parts[0]), np.cos(self.parts[0])
        return self.map(c, -s, -c)


def lifted(value: Any) -> HyperDual:
    return value if isinstance(value, HyperDual) else HyperDual(value)


def derivatives(cost: Callable[[Sequence[HyperDual]], HyperDual], x: Array) -> tuple[Array, Array]:
    """Gradient (n,) and Hessian (n, n) of a cost of n numbers."""
    n = len(x)
    eye = np.eye(n)
    zero = np.zeros((n, n))
    _, b, _, d = cost([HyperDual(x[k], eye[k][:, None] + zero, eye[k][None, :] + zero, zero) for k in range(n)]).parts
    return np.asarray(b)[:, 0], np.asarray(d)
