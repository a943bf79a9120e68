"""A filter without a guard: what there is of it compiles to nothing."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import implement
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Open,
    Slam,
    State,
    make_watch,
    may_enter,
    rejected_rows,
    screen,
)
from consistency.referee.types import Array


class NoWatch(NamedTuple):
    """Nothing to remember."""


@implement(make_watch, Open)
def watch_nothing(guard: Open, s: int, m: int, rows: int, n_landmarks: int) -> NoWatch:
    return NoWatch()


@implement(screen, Open)
def screen_nothing(
    guard: Open,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    local: NamedTuple,
    work: NamedTuple,
    watch: NoWatch,
) -> tuple[int, int, bool]:
    return 0, m, False


@implement(may_enter, Open)
def all_new_may_enter(guard: Open, row: int, is_known: bool, watch: NoWatch) -> bool:
    return not is_known


@implement(rejected_rows, Open)
def no_rows(guard: Open, watch: NoWatch) -> Array:
    return np.empty(0, np.bool_)
