"""What local updating carries beside the state, see :mod:`consistency.filters.covariance_update.local`."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.arrays import filled, integers, matrix, vector
from consistency.referee.types import Array, Indices


class Factors(NamedTuple):
    """The active part, of up to ``c`` variables of ``n``, and what the passive rest is owed."""

    x: Array  # (c,)
    P: Array  # (c, c), as ``covariance`` keeps it
    Phi: Array  # (c, c)
    Psi: Array  # (c, c), upper half
    theta: Array  # (c,)
    label: Indices  # labels of the active landmarks in their order
    base: Indices  # offsets in the whole state of the landmarks in the base
    rows: Array  # (c, n) P0_base,all
    owed: Array  # (c, n) Psi P0_base,all, then Phi P0_base,all
    cross: Array  # (c, c) P0_l,base of the landmarks l that join
    gain: Array  # (c, c) P0_l,base Psi
    tally: Array  # (6,) what the rules for when to settle count


@inner
def make_factors(c: int, width: int, landmarks: int) -> Factors:
    """Arrays for ``c`` active variables with up to ``landmarks`` landmarks, of ``width`` in all."""
    return Factors(
        vector(c),
        matrix(c, c),
        matrix(c, c),
        matrix(c, c),
        vector(c),
        integers(landmarks, 0),
        integers(landmarks, 0),
        matrix(c, width),
        matrix(c, width),
        matrix(c, c),
        matrix(c, c),
        filled(6, 0.0),
    )
