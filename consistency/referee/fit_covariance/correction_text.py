"""A correction of a stated covariance in sentences, tables and numbers for programs."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import compress
from typing import Any

import numpy as np

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.verdict.as_dictionary import plain
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.diagnostics.words.numbers import plural, short
from consistency.referee.document.blocks import Block, Column, Document, Table, Text, table
from consistency.referee.fit_covariance.correct import FEW, LEVELS, Correction, HeldOut
from consistency.referee.fit_covariance.covariance_ratios import IN_TURN, shown

UNITS = {"position": " m", "attitude": " rad", "velocity": " m/s"}


def correction_sentence(found: Correction) -> str:
    """The end that was reached, the ratios, and how they were found."""
    before, after = found.before.ratio, found.after.ratio
    how = f"{plural(len(found.judged), found.unit)}, each judged by the factors of the others"
    if found.held_out != IN_TURN:
        how = f"fitted on {plural(len(found.fitted), found.unit)}, judged on {len(found.judged)} others"
    parts = [f"{found.status} after: held-out covariance ratio {shown(before)} before and {shown(after)} after", how]
    if found.status == "undecided":
        decided_by = (
            f"about {plural(found.needed, found.unit)} would decide" if found.needed else found.verdict.reasons[0]
        )
        parts.append(decided_by)
    if found.status == "inconsistent":
        parts.append(f"no factor mends this: {found.verdict.reasons[0]}")
    elif not found.is_needed:
        parts.append(f"no factor is shown to be needed, at {CONFIDENCE:.0%} for all of them together")
    return "; ".join(parts)


def correction_document(found: Correction) -> Document:
    """Sentence, factors, held-out figures, and limits; numbers as data."""
    opening: list[Block] = [Text(f"{found.name}: {correction_sentence(found)}"), _factors(found), _figures(found)]
    opening += map(Text, correction_lines(found))
    return Document(
        f"{found.name}: correction of the stated covariance", "", (), tuple(opening), data_of_correction(found)
    )


def _factors(found: Correction) -> Table:
    """A row for each block, in each group; columns of groups and floors where there are some."""
    fits = found.shown
    has_floors = any(each.high > 0.0 for fit in fits.values() for each in fit.floor)
    is_shown = (len(found.fits) > 1, True, True, True, True, has_floors)
    factor_heads = Column("factor on variances"), Column("on sigmas", number=True)
    columns = (Column("group"), Column("block"), Column("components"), *factor_heads, Column("floor, as a sigma"))
    rows = []
    for group, fit in fits.items():
        for block, factor, floor in zip(found.blocks, fit.factor, fit.floor, strict=True):
            names = " ".join(found.axes[i] for i in block.places)
            on_sigmas = f"x{short(float(np.sqrt(factor.value)))}"
            row = (group, block.name, names, shown(factor), on_sigmas, _sigma(floor, block.name))
            rows.append(tuple(compress(row, is_shown)))
    return table(tuple(compress(columns, is_shown)), rows, "Factors of each block", style="plain")


def _sigma(floor: Interval, block: str) -> str:
    """A floor as a standard deviation, with its unit where that is known."""
    unit = UNITS.get(block, "")
    value, low, high = np.sqrt(floor)
    return f"{value:.2g}{unit} [{low:.2g}, {high:.2g}]"


def _figures(found: Correction) -> Table:
    columns = (Column("held-out"), Column("stated"), Column("corrected"), Column("expected", number=True))
    before, after = found.before, found.after
    rows = [("covariance ratio", shown(before.ratio), shown(after.ratio), "1")]
    for level, stated, corrected in zip(LEVELS, before.covered(LEVELS), after.covered(LEVELS), strict=True):
        rows.append((f"inside {level:.0%}", f"{stated:.1%}", f"{corrected:.1%}", f"{level:.0%}"))
    return table(columns, rows, "Held-out errors beside the stated and the corrected covariance", style="plain")


def correction_lines(found: Correction) -> Iterator[str]:
    """Gain of the log score, what the uncertainty of the factors does, and limits."""
    gain = found.gain
    ends = f" [{gain.low:.3g}, {gain.high:.3g}]" if np.isfinite(gain.low) else ""
    yield f"log score gained a step, on average over {found.unit}s: {gain.value:.3g}{ends}"
    if len(found.fitted) < FEW and np.isfinite(found.excess):
        without = found.after.ratio.value / found.excess
        yield (
            f"factors of {plural(len(found.fitted), found.unit)} are uncertain, which adds x{found.excess:.3g} to a "
            f"held-out ratio; without it the ratio is {short(without)}"
        )
    if found.verdict.status != found.after.verdict.status:
        yield (
            f"analyse says of held-out/: {found.after.verdict.reasons[0]}; it takes the factors for exact, while here "
            "their uncertainty is taken in"
        )
    if len(found.fits) > 1 and not any(fit.factors.floor.any() for fit in found.shown.values()):
        yield "floors are 0 in all groups"
    else:
        yield from (note for fit in found.shown.values() for note in fit.notes)
    yield "the factors hold for data like these; those of new conditions may be others"


def data_of_correction(found: Correction) -> dict[str, Any]:
    """Everything as plain data, as correction.toml and --json have it."""
    groups = found.before.record.groups
    return dict(
        plain({
            "name": found.name,
            "status": found.status,
            "sentence": correction_sentence(found),
            "held_out": found.held_out,
            "fitted_runs": found.fitted,
            "judged_runs": found.judged,
            "needed_runs": found.needed,
            "convention": found.before.record.convention,
            "excess": found.excess,
            "log_score_gain": found.gain,
            "by": groups.column if groups is not None else None,
            "edges": groups.edges if groups is not None else None,
            "blocks": [_block(found, group, b) for group in found.shown for b in range(len(found.blocks))],
            "stated": _held_out(found.before),
            "corrected": _held_out(found.after),
            "notes": [note for fit in found.shown.values() for note in fit.notes],
            "referee": found.verdict.statistics,
        })
    )  # fmt: skip


def _block(found: Correction, group: str, b: int) -> dict[str, Any]:
    """Factor and floor of a block, in a group where there are groups."""
    block, fit = found.blocks[b], found.fits[group]
    return {
        "group": group or None,
        "name": block.name,
        "components": [found.axes[i] for i in block.places],
        "factor": fit.factors.factor[b],
        "factor_interval": fit.factor[b][1:],
        "floor": fit.factors.floor[b],
        "floor_interval": fit.floor[b][1:],
        "degrees_of_freedom": fit.dof[b],
    }


def _held_out(one: HeldOut) -> dict[str, Any]:
    names = (f"inside_{100 * level:.0f}" for level in LEVELS)
    coverage = dict(zip(names, one.covered(LEVELS), strict=True))
    return {"ratio": one.ratio.value, "ratio_interval": one.ratio[1:], **coverage, "log_score": one.scores.mean()}
