"""Errors that all estimates share: fitted to other drives or to one half, and taken from those that are judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from consistency.referee.diagnostics import Evidence
from consistency.referee.diagnostics.imperfect_truth.shared_errors import (
    KINDS,
    fit_record,
    halves,
    without_shared,
)
from consistency.referee.diagnostics.records.record import numbered_axes
from consistency.referee.errors import InputError
from consistency.referee.readers.options import Reading, flag_of

REFUSED = {
    "split": ": pieces of one log all have what is constant over it",
    "truth_covariance": ": what the truth scatters by is fitted as a floor",
    "align": ": a fitted frame takes a part of what all estimates share",
}
ONE_LOG = "what all estimates share was fitted to one half of the same log, and other drives may have other errors"


def require_shared_options(r: Reading) -> None:
    """Refuse an unknown kind of what is shared, or one that does not go with other options."""
    if r.shared is None:
        if given := r.given(["shared_from", "shared_truth"]):
            raise InputError(f"{flag_of(given[0])}: needs --shared {'|'.join(KINDS)}")
        return
    if r.shared not in KINDS:
        raise InputError(f"--shared {r.shared}: must be {', '.join(KINDS[:-1])} or {KINDS[-1]}")
    r.refuse("--shared", REFUSED)


def other_drives(r: Reading) -> Reading:
    """Options of the drives that what is shared is fitted to."""
    truth = r.shared_truth if r.shared_truth is not None else r.truth
    return replace(r, truth=truth, shared=None, shared_from=None, shared_truth=None)


def less_shared(records: Sequence[Evidence], others: Sequence[Evidence] | None, kind: str) -> list[Evidence]:
    """Records without what they share with the same estimators of other drives, or the second half with the first.

    Raises
    ------
    InputError
        An estimator is not among the others, or what is shared cannot be fitted.
    """
    named = {record.name: record for record in others or ()}
    found = []
    for record in records:
        if others is None:
            first, rest = halves(record)
            one_log = len(record.run_numbers) == 1
            less = _less(rest, first, kind, "the first half of the " + ("log" if one_log else "runs"))
            found.append(replace(less, unshown=less.unshown or ONE_LOG * one_log))
            continue
        other = others[0] if len(others) == len(records) == 1 else named.get(record.name)
        if other is None:
            raise InputError(f"--shared-from: holds no estimator '{record.name}'; it has {', '.join(named)}")
        found.append(_less(record, other, kind, "other drives"))
    return found


def _less(record: Evidence, other: Evidence, kind: str, data: str) -> Evidence:
    """The record without what another shows, with what was fitted among its notes, and a caption of its verdict."""
    fit = fit_record(other, kind)
    record = without_shared(record, fit, kind)
    axes = record.axes or numbered_axes(len(fit.floor))
    each = {"by-vector": "", "by-time": " a second", "by-distance": " a metre"}[kind]
    means = ", ".join(f"{axis} {value:.3g}" for axis, value in zip(axes, fit.mean, strict=True))
    floors = ", ".join(f"{value:.2g}" for value in fit.floor)
    note = f"{record.name}: errors that all share, fitted to {data}: {means}{each}; floor {floors}"
    caption = f"with the errors that all share taken off, and a floor, as fitted to {data}; a bias is not asked"
    return replace(record, notes=(*record.notes, note), caption="; ".join(filter(None, (record.caption, caption))))
