"""Records with other values, by the name of what changes alone."""

from dataclasses import fields, replace
from typing import Any

from consistency.referee.diagnostics.record import (
    Errors,
    InnovationRecord,
    Map,
    Origin,
    Record,
    Runs,
    Truth,
    TruthFit,
)

VALUES = {
    "errors": Errors,
    "innovations": InnovationRecord,
    "runs": Runs,
    "fit": TruthFit,
    "map": Map,
    "origin": Origin,
}
PLACES = {field.name: value for value, kind in VALUES.items() for field in fields(kind)}
PLACES |= {f"truth_{field.name}": "truth" for field in fields(Truth)}


def changed(record: Record, **given: Any) -> Record:
    """The record with fields of its values changed: ``changed(record, nees=nees, reduced=True)``."""
    for name, value in given.items():
        if name not in PLACES:
            record = replace(record, **{name: value})
            continue
        place = PLACES[name]
        part = replace(getattr(record, place), **{name.removeprefix("truth_"): value})
        record = replace(record, **{place: part})
    return record
