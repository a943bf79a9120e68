"""The smallest point that is still bad: as few values other than the plain ones as possible, then nearer to them."""

from __future__ import annotations

from collections.abc import Callable

from consistency.bench.challenging.worlds import Point, Space, Value

SIZE = "steps"  # the dimension that makes a world small by itself; it is shrunk last, and no matter towards what
HALVINGS = 3  # of the way to the plain value


def shrink(space: Space, worst: Point, holds: Callable[[Point], bool], left: Callable[[], bool]) -> Point:
    """The smallest point found on the way from ``worst`` to the plain one at which ``holds`` is still true.

    Dimensions are done without one at a time, in their order, until none can be; what remains is moved half the way to
    the plain value, up to three times; at last the world gets fewer steps. ``holds`` is asked once a point, and not
    after ``left`` has become false.
    """
    known: dict[Point, bool] = {worst: True}

    def passes(point: Point) -> bool:
        if point not in known and left():
            known[point] = holds(point)
        return known.get(point, False)

    point = _without(space, worst, passes)
    for i, dimension in enumerate(space.dimensions):
        if dimension.name != SIZE:
            for _ in range(HALVINGS):
                nearer = _with(point, i, dimension.between(point[i]))
                if nearer == point or not passes(nearer):
                    break
                point = nearer
    return _fewer(space, point, passes)


def _without(space: Space, point: Point, passes: Callable[[Point], bool]) -> Point:
    """With as many plain values as pass, one at a time; all at once first."""
    sizes = {i: point[i] for i, d in enumerate(space.dimensions) if d.name == SIZE}
    plain = tuple(sizes.get(i, value) for i, value in enumerate(space.plain))
    if passes(plain):
        return plain
    before = None
    while point != before:
        before = point
        for i in range(len(point)):
            simpler = _with(point, i, plain[i])
            if simpler != point and passes(simpler):
                point = simpler
    return point


def _fewer(space: Space, point: Point, passes: Callable[[Point], bool]) -> Point:
    """With the fewest steps if they pass, and otherwise by bisection."""
    for i, dimension in enumerate(space.dimensions):
        if dimension.name != SIZE:
            continue
        fewest = _with(point, i, dimension.at(0.0))
        if passes(fewest):
            return fewest
        low, high = 0.0, dimension.where(point[i])
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            fewer = _with(point, i, dimension.at(middle))
            if passes(fewer):
                point, high = fewer, middle
            else:
                low = middle
    return point


def _with(point: Point, i: int, value: Value) -> Point:
    return (*point[:i], value, *point[i + 1 :])
