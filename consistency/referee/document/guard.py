"""What guards rejected, in rows and columns and in words."""

from __future__ import annotations

from consistency.referee.diagnostics.verdict.parts import Interval, RejectionScore
from consistency.referee.document.blocks import Cell, Column, Quantity
from consistency.referee.document.wording import NONE

REJECTION_COLUMNS = (
    Column("Observations", number=True),
    Column("Spurious", number=True),
    Column("Rejected", number=True),
    Column("Precision, %", number=True),
    Column("Recall, %", number=True),
    Column("Right ones rejected, %", "Right ones\nrejected, %", number=True),
)


def rejection_cells(r: RejectionScore) -> tuple[Cell, ...]:
    """Cells of a page, as COLUMNS."""
    shares = [_percent(share) for share in (r.precision, r.recall)] if r.spurious else [NONE, NONE]
    spurious = str(r.spurious) if r.spurious else NONE
    return str(r.offered), spurious, str(r.rejected), *shares, _percent(r.false_alarms)


def _percent(share: Interval) -> Quantity:
    value, low, high = (100 * end for end in share)
    return Quantity(value, (low, high))


def rejection_text(r: RejectionScore) -> str:
    """What a guard rejected, and where spurious observations are known precision and recall."""
    rejected = f"{r.rejected} of {r.offered} observations"
    if not r.spurious:
        return f"{rejected} ({_percent_text(r.false_alarms)})"
    return (
        f"{rejected}, {r.spurious} of them spurious: precision {_percent_text(r.precision)}, "
        f"recall {_percent_text(r.recall)}, right ones rejected {_percent_text(r.false_alarms)}"
    )


def _percent_text(share: Interval) -> str:
    value, low, high = (f"{100 * end:.3g}" for end in share)
    return f"{value if value != 'nan' else '-'} [{low}, {high}] %"
