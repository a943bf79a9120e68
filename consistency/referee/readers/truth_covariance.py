"""Truth with a covariance of its own: what the options declare of it, and what they do not go with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from consistency.referee.diagnostics.number_words import plural
from consistency.referee.diagnostics.record import Record, Truth
from consistency.referee.diagnostics.uncertain_truth import DECLARED
from consistency.referee.diagnostics.whitening import ROUNDED, Validity, classify
from consistency.referee.errors import InputError
from consistency.referee.readers.options import Reading, flag_of

REFUSED = {
    "relative": ": neighbouring windows share the truth at their common end, so that its errors are in both",
    "motions": ": a motion has the errors of the truth at both ends, whose cross-covariance no file states",
    "split": ": pieces of one log share the truth's errors, in a way that no log shows",
    "by": ": what the truth's errors have in common with a group is not known",
    "align": ": a frame that is fitted to an uncertain truth takes an unknown share of the truth's errors",
}


def require_truth_options(r: Reading) -> None:
    """Refuse declarations that are unknown, or an uncertain truth where its errors do not enter once in each step.

    Raises
    ------
    InputError
        Names the option, and the reason.
    """
    if r.truth.truth_errors not in (None, *DECLARED):
        raise InputError(f"--truth-errors {r.truth.truth_errors}: must be {', '.join(DECLARED[:-1])} or {DECLARED[-1]}")
    if asked := r.given(["truth_covariance", "truth_errors", "truth_shared"]):
        r.refuse(flag_of(asked[0]), REFUSED)


def declared(records: Sequence[Record], r: Reading) -> list[Record]:
    """Records with what is declared of the errors of the truth.

    Raises
    ------
    InputError
        The truth has no covariance, or one that is none.
    """
    asked = r.given(["truth_errors", "truth_shared"])
    found = []
    for record in records:
        P = record.truth.covariance
        if P is None:
            if asked:
                raise InputError(
                    f"{flag_of(asked[0])}: the truth of {record.name} has no covariance of its own; name it by "
                    "--truth-covariance"
                )
            found.append(record)
            continue
        if record.errors.parts:
            raise InputError(f"{record.name}: --truth-covariance needs covariances; here deviations alone are stated")
        kind = classify(P, ROUNDED)
        wrong = np.argwhere((kind == Validity.INDEFINITE) | (kind == Validity.ASYMMETRIC))
        if len(wrong):
            run, step = wrong[0]
            raise InputError(
                f"{record.name}: the covariance of the truth in run {record.run_numbers[run]}, step {step + 1} is not "
                "a covariance: it is not symmetric, or negative in some direction"
            )
        record = replace(record, truth=Truth(P, r.truth.truth_errors, bool(r.truth.truth_shared)))
        missing = 0
        if record.errors.nees is not None:
            unknown = np.isnan(P).any(axis=(2, 3))
            missing = int((unknown & np.isfinite(record.errors.nees)).sum())
        if missing and not np.isfinite(P).any():
            raise InputError(f"{record.name}: the truth has a covariance in none of the steps that are judged")
        if missing:
            note = f"{record.name}: {plural(missing, 'estimate')} whose truth has no covariance are left out"
            record = record.with_notes(note)
        found.append(record)
    return found
