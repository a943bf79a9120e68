"""The figures of a verdict, each as the cell of a table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from consistency.referee.diagnostics import Verdict
from consistency.referee.diagnostics.wording import UNCERTAIN, plain
from consistency.referee.document.blocks import Cell, Quantity, Status
from consistency.referee.document.wording import brief, number, p_cell

NONE = Quantity(None)


def status(v: Verdict) -> Status:
    return Status(v.status)


def status_and_source(v: Verdict) -> Status:
    """Also whether the innovations alone decided."""
    return Status(v.status, " (NIS only)" if v.scale is None else "")


def mean_anees(v: Verdict, digits: str = "") -> Cell:
    return NONE if v.scale is None else Quantity(v.scale.mean_anees, digits=digits)


def ratio(v: Verdict) -> Cell:
    """True over stated covariance."""
    return NONE if v.scale is None else Quantity(v.scale.inflation.value, v.scale.inflation[1:])


def factor(v: Verdict) -> Quantity:
    """What makes the stated covariance that of the errors."""
    if v.scale is None:
        return NONE
    return Quantity(v.scale.inflation.value, v.scale.inflation[1:], limit=UNCERTAIN, is_factor=True)


def shown_inside(v: Verdict) -> Cell:
    """Whether the ratio of true to stated covariance was shown to lie where it should, and the p value."""
    shown = v.equivalence
    if shown is None or not np.isfinite(shown.p_value):
        return NONE
    return f"{'yes' if shown.shown else 'no'}, p {p_cell(shown.p_value)}"


def worst_axis(v: Verdict) -> Cell:
    """Axis whose ratio of true to stated covariance is farthest from 1, and that ratio."""
    return NONE if v.worst_axis is None else f"{v.worst_axis[0]}, {plain(v.worst_axis[1])}"


def mainly(v: Verdict) -> Cell:
    """Axes that carry the fault."""
    return v.subset or NONE


def since(v: Verdict) -> Cell:
    """Step from which on the fault is there."""
    return NONE if v.location is None or v.location.since is None else str(v.location.since)


def rmse_position(v: Verdict) -> Cell:
    accuracy = v.in_world.accuracy
    return NONE if accuracy is None else Quantity(accuracy.rmse_position, digits=".3f")


def rmse_heading(v: Verdict) -> Cell:
    accuracy = v.in_world.accuracy
    return NONE if accuracy is None else Quantity(np.rad2deg(accuracy.rmse_heading), digits=".2f")


def nis(v: Verdict) -> Quantity:
    """NIS per degree of freedom."""
    return NONE if v.innovations is None else Quantity(v.innovations.ratio, digits=".3f")


def nis_aside(v: Verdict) -> Cell:
    """Also whether it is judged."""
    return replace(nis(v), is_aside=v.innovations is not None and not v.innovations.judged)


def failed(v: Verdict) -> Cell:
    return f"{len(v.failures)} of {v.runs}"


def accepted(v: Verdict) -> Cell:
    """Mean NEES that a right filter has."""
    if v.scale is None or np.isnan(v.scale.accepted[0]):
        return NONE
    return " to ".join(map(brief, v.scale.accepted))


def detectable(v: Verdict) -> Cell:
    """Covariance ratio that these runs would find."""
    return NONE if v.scale is None else Quantity(v.scale.detectable, digits=".2g", is_factor=True)


def coverage(v: Verdict) -> Cell:
    """Share of errors within two standard deviations, by component."""
    shares = np.empty(0) if v.accuracy is None else v.accuracy.coverage
    return " / ".join(number(100 * share, ".1f") for share in shares) if np.isfinite(shares).any() else NONE


def noncredibility(v: Verdict) -> Cell:
    return NONE if v.accuracy is None else Quantity(v.accuracy.nci, digits=".1f")


def inclination(v: Verdict) -> Cell:
    return NONE if v.accuracy is None else Quantity(v.accuracy.inclination, digits="+.1f")


def nis_expected(v: Verdict) -> Cell:
    """NIS per degree of freedom, and where that of a right filter lies."""
    if v.innovations is None or not np.isfinite(v.innovations.ratio):
        return NONE
    low, high = (number(end, ".3f") for end in v.innovations.interval)
    return f"{v.innovations.ratio:.3f} ({f'{low} to {high}' if v.innovations.judged else 'not judged'})"
