"""Filters by name or as objects, checked against the sensor that they are to work on."""

from __future__ import annotations

from collections.abc import Sequence

from consistency.bench.filters import filter_names, get_filter, usable_names
from consistency.bench.filters.filter_declarations import error_of, name_of
from consistency.bench.protocols import Filter
from consistency.bench.scenario import Belief
from consistency.bench.scenario.tables.toml_tables import UNITS
from consistency.referee.errors import InputError
from consistency.referee.parsing import require_name


def resolve_filters(
    filters: str | Filter | Sequence[str | Filter], belief: Belief, log: str | None = None
) -> list[Filter]:
    """Filters by name or as they are, checked against the sensor, of the log in a folder or of a scenario."""
    filters = [filters] if isinstance(filters, str | Filter) else filters
    instances = [get_filter(f) if isinstance(f, str) else f for f in filters]
    if not instances:
        raise InputError(f"no filter given; known: {', '.join(filter_names())}")
    for filter_ in instances:
        if isinstance(filter_, type) or not isinstance(filter_, Filter):
            hint = (
                "give an object of it, with ()" if isinstance(filter_, type) else "it needs init, predict, update, pose"
            )
            raise InputError(f"{filter_!r} is not a filter: {hint}")
    names = [name_of(f) for f in instances]
    if len(set(names)) < len(names):
        raise InputError(f"a filter is given twice: {', '.join(sorted({n for n in names if names.count(n) > 1}))}")
    built_in = filter_names()
    for given, name in zip(filters, names, strict=True):
        is_ours = isinstance(given, str) or type(given).__module__.startswith("consistency.")
        if name in built_in and not is_ours:
            raise InputError(f"filter '{name}': is a built-in filter; give yours another name")
    model = belief.sensor.model
    for filter_ in instances:
        require_name(name_of(filter_), "filter")
        error_of(filter_)
        sensors = getattr(filter_, "sensors", None)
        if sensors is not None and model not in sensors:
            fitting = [name for name in usable_names() if model in getattr(get_filter(name), "sensors", (model,))]
            raise InputError(
                f"filter '{name_of(filter_)}' works on a sensor {' or '.join(sensors)}, not '{model}'; "
                f"filters that fit: {', '.join(fitting)}"
            )
        for key in getattr(filter_, "needs", ()):
            if getattr(belief.sensor, key) is None:
                unit = f"{key}{UNITS.get(key, '')}"
                place = f"key 'belief.sensor.{unit}'" if log is None else f"{log}/sensor.toml: key '{unit}'"
                raise InputError(f"{place}: missing; filter '{name_of(filter_)}' needs it, so add it or leave it out")
    return instances
