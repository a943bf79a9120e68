"""A stated covariance corrected by factors and floors, judged on runs that chose nothing.

What was found is told in sentences, tables and numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.number_words import plural, short
from consistency.referee.diagnostics.record import Map, Record, numbered_axes
from consistency.referee.diagnostics.scale import ratio_interval, run_means
from consistency.referee.diagnostics.verdict import Verdict, plain
from consistency.referee.diagnostics.verdict_parts import Interval
from consistency.referee.diagnostics.whitening import squared_length, whiten
from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.correct_bounds import BoundCorrection, correct_bounds
from consistency.referee.fit_covariance.covariance_ratios import IN_TURN, fitted_and_judged, require_fixed_groups, shown
from consistency.referee.fit_covariance.estimation import log_densities, mean_over_runs
from consistency.referee.fit_covariance.factors import (
    KINDS,
    FactorBlock,
    Factors,
    Fit,
    blocks_of,
    fit_runs,
    run_weights,
    stated_errors,
    steps_of_runs,
)
from consistency.referee.readers.options import make_reading
from consistency.referee.readers.pipeline.arrays_in_memory import record_of_arrays
from consistency.referee.readers.pipeline.read_files import checked_options
from consistency.referee.readers.pipeline.relative_motions import rows_as_declared
from consistency.referee.show.blocks import Block, Column, Document, Table, Text, table
from consistency.referee.system import progress
from consistency.referee.types import Array, Indices
from consistency.referee.verdicts.judge_sources import judge_all, source_of

LEVELS = (0.68, 0.95, 0.99)
ByGroup = tuple[Factors, ...]  # of each group, and last of all steps
FEW = 30  # runs; with fewer what the uncertainty of the factors adds to a ratio is printed
UNITS = {"position": " m", "attitude": " rad", "velocity": " m/s"}


@dataclass(frozen=True)
class HeldOut:
    """Errors of judged runs beside a covariance."""

    record: Record = field(repr=False)
    verdict: Verdict = field(repr=False)  # what ``analyse`` says of it
    ratio: Interval  # of true to stated covariance
    scores: Array  # log density of a step, mean of each run that has one

    @property
    def ratios(self) -> Array:
        """Ratio of true to stated covariance of each run, (R,); NaN of one without a step."""
        _, _, nees = stated_errors(self.record)
        means, counts = run_means(nees)
        return np.where(counts > 0, means, np.nan) / self.record.errors.dof

    def covered(self, levels: Sequence[float] | Array) -> Array:
        """Share of the errors inside the ellipsoid of each probability, mean over runs."""
        _, _, nees = stated_errors(self.record)
        bounds = special.chdtri(self.record.errors.dof, 1.0 - np.asarray(levels))
        return np.array([average(np.where(np.isfinite(nees), nees <= bound, np.nan)) for bound in bounds])


@dataclass(frozen=True)
class Correction:
    """Factors and floors for a stated covariance, with the verdict on errors that chose nothing."""

    name: str
    blocks: tuple[FactorBlock, ...]
    fits: Mapping[str, Fit] = field(repr=False)  # by group; the last one, "", is of all steps
    held_out: str  # "in turn", "half" or names
    runs: tuple[str, ...]  # names of all runs
    fitted: tuple[str, ...]
    judged: tuple[str, ...]
    used: tuple[ByGroup, ...]  # of each judged run, from other runs
    before: HeldOut  # the judged runs as they are stated
    after: HeldOut  # corrected, as the files of held-out/ have them
    verdict: Verdict = field(repr=False)  # with the uncertainty of the factors taken in
    excess: float  # what that uncertainty adds to the ratio of held-out runs
    gain: Interval  # of the log score, a step
    assumed: bool = False  # no covariance was stated: it is I, so that factors are variances

    @property
    def fit(self) -> Fit:
        """That of all steps, whatever their group."""
        return self.fits[""]

    @property
    def shown(self) -> dict[str, Fit]:
        """Fits by group; without groups the one of all steps, by the name ""."""
        return {group: fit for group, fit in self.fits.items() if group or len(self.fits) == 1}

    @property
    def is_needed(self) -> bool:
        """Whether any factor but 1, or floor, is shown to be needed, all of them taken together."""
        return are_needed(tuple(self.shown.values()))

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the components of the error."""
        return tuple(self.before.record.errors.axes) or numbered_axes(self.before.record.errors.dof)

    @property
    def unit(self) -> str:
        """What a run is called."""
        return self.before.record.runs.unit

    @property
    def needed(self) -> int | None:
        """Runs that would probably decide, where those judged do not; None where that is not known."""
        shown = self.verdict.equivalence
        if shown is None or shown.runs is None:
            return None
        return max(shown.runs, len(self.judged) + 1)

    @property
    def status(self) -> str:
        """consistent, undecided, or inconsistent where no factor mends what is wrong."""
        status = self.verdict.status
        return status if status in ("consistent", "undecided") else "inconsistent"

    def covariance(self, stated: ArrayLike, group: str = "") -> Array:
        """Corrected covariances of stated ones, (..., n, n), in a group where factors go by group."""
        return self.fits[group].factors.applied(np.asarray(stated, float))

    def plot(self, path: str | Path | None = None) -> Any:
        """Ratios of held-out runs, factors with intervals, and coverage; needs ``[plot]``.

        Parameters
        ----------
        path : .png, .pdf or .svg to write as well; one that is there is replaced
        """
        from consistency.referee.fit_covariance.pictures import draw_correction
        from consistency.referee.pages.write_pages import plotted

        return plotted(partial(draw_correction, self), path)

    def __repr__(self) -> str:
        return f"<Correction {self.name}: {correction_sentence(self)}>"


def correct(
    record: Record | ArrayLike,
    covariances: ArrayLike | None = None,
    *,
    axes: Sequence[str] | None = None,
    held_out: str | None = None,
    per_axis: bool = False,
    names: Sequence[str] | None = None,
    independent: bool = False,
    bounds: ArrayLike | None = None,
    level: str | float | Mapping[str, Any] | None = None,
) -> Correction | BoundCorrection:
    """Fit factors to the covariances or bounds that an estimator states, and judge them on runs that chose nothing.

    Where neither is stated the covariance is I, and gets a factor for each component.

    Parameters
    ----------
    record : of :func:`consistency.read`; or errors (runs, steps, n), truth minus estimate
    covariances : (runs, steps, n, n), beside errors; I where None
    axes : (n,), names of the components of errors: x, y, z; roll, pitch, yaw or heading; vx, vy, vz make up blocks
    held_out : names of runs that are judged and not fitted, with commas; "half": the second half of the runs; None:
        each run is judged by the factors of all others
    per_axis : a factor for each component, in place of one for position, attitude and velocity
    names : of the runs, for messages and ``held_out``; their numbers where None
    independent : errors are (N, n), or (runs, steps, n), and each row is an independent run
    bounds, level : in place of covariances, as for :func:`consistency.judge`: the factor of a bound is one with which
        a new run is expected to leave it in at most 1 - level of its steps

    Returns
    -------
    Correction, or BoundCorrection of bounds

    Raises
    ------
    InputError
        There is one run, or none with errors and covariances; fewer runs than the level of a bound takes (20 at 95 %);
        or a name is not there.
    """
    if not isinstance(record, Record) and bounds is not None:
        if covariances is not None:
            raise InputError("covariances, bounds: give one of them beside errors")
        options = checked_options(make_reading(level=level))
        record = record_of_arrays({"errors": record, "bounds": bounds}, axes, "estimator", independent, options)
        record = rows_as_declared(record)
    elif bounds is not None or level is not None:
        raise InputError("bounds and level: go together, beside errors; a record has its own")
    elif not isinstance(record, Record):
        shape = np.shape(record)
        unit = np.broadcast_to(np.eye(shape[-1] if shape else 1), (*shape, *shape[-1:]))
        given = {"errors": record, "covariances": unit if covariances is None else covariances}
        record = record_of_arrays(given, axes, "estimator", independent)
        record = rows_as_declared(record)
        record = replace(record, errors=replace(record.errors, assumed=covariances is None))
    labels = tuple(map(str, record.run_numbers if names is None else names))
    if record.errors.bounded:
        if per_axis:
            raise InputError("--per axis: is for covariances; each bound has a factor of its own")
        return correct_bounds(record, labels, held_out)
    require_runs(record)
    _, _, nees = stated_errors(record)
    counted = np.asarray(np.isfinite(nees).any(axis=1))
    fitted, judged = fitted_and_judged(labels, counted, held_out)
    blocks = blocks_of(record.errors.axes, record.errors.dof, per_axis or record.errors.assumed)
    with progress("correction", 3, "parts", brief=True) as advance:
        fits = fit_groups(record.of_runs(fitted), blocks)
        advance(1)
        place = {run: row for row, run in enumerate(fitted)}
        used = tuple(by_group(fits, place.get(run)) for run in judged)
        some = replace(record, map=Map(), world=None).of_runs(judged)
        before = held_out_by(some)
        advance(1)
        after = held_out_by(with_factors(some, used))
        advance(1)
    dof = np.array([fit.dof for fit in fits.values()])
    return Correction(
        name=record.name,
        blocks=blocks,
        fits=fits,
        held_out=held_out or IN_TURN,
        runs=labels,
        fitted=tuple(labels[i] for i in fitted),
        judged=tuple(labels[i] for i in judged),
        used=used,
        before=before,
        after=after,
        verdict=verdict_of(with_uncertainty(after.record, blocks, dof)),
        excess=excess_of(after.record, blocks, dof),
        gain=mean_over_runs(run_weights(after.record) * (after.scores - before.scores)),
        assumed=record.errors.assumed,
    )


def the_record(records: Sequence[Record], name: str | None = None) -> Record:
    """The record of the one estimator, or of that named.

    Raises
    ------
    InputError
        There are several, or none of this name.
    """
    source = source_of(records)
    if name is not None:
        return source.record(name)
    if len(source.filters) > 1:
        there = ", ".join(source.filters)
        raise InputError(f"these files hold several estimators: name one by --filter; there are: {there}")
    return records[0]


def require_runs(record: Record) -> None:
    """Refuse a record that has no covariances, or one run alone."""
    if record.errors.error is None or record.errors.covariance is None or record.errors.nees is None:
        raise InputError(f"{record.name}: needs errors and covariances, of files with a truth")
    require_fixed_groups(record)
    if record.guesses:
        raise InputError("--error guess: a correction is of one error; declare the one that the covariance is of")
    runs = int(np.isfinite(record.errors.nees).any(axis=1).sum())
    if runs == 1:
        from consistency.referee.diagnostics.planning import FEWEST

        raise InputError(
            f"{record.name}: one log has no other to judge its factors by; give several runs, or cut it with --split "
            f"auto, which takes {FEWEST} pieces or more that do not depend on each other; rows that do not, as images "
            "or detections, are runs with --independent"
        )
    if runs == 0:
        raise InputError(f"{record.name}: no run has a step with an error and a covariance of full rank")


def fit_groups(record: Record, blocks: tuple[FactorBlock, ...]) -> dict[str, Fit]:
    """Fits to the steps of each group, by its name, and last, by the name "", that of all steps.

    A group that fewer than two runs pass through has the fit of all steps.
    """
    _, _, nees = stated_errors(record)
    fits = {}
    names = record.groups.names if record.groups is not None else ()
    whole = fit_runs(record, blocks)
    asked = max(len(names), 1)
    for number, name in enumerate(names):
        of_group = np.where(group_index(record) == number, nees, np.nan)
        some = replace(record.with_nees(of_group), groups=None)
        there = np.asarray(np.isfinite(of_group).any(axis=1))
        if there.sum() < 2:
            fits[name] = replace(whole, notes=(f"{name}: fewer than two runs; the factors are those of all steps",))
            continue
        fit = fit_runs(some.of_runs(np.flatnonzero(there)), blocks, asked)
        left_out = iter(fit.left_out)
        of_runs = tuple(next(left_out) if is_there else fit.factors for is_there in there)
        fits[name] = replace(fit, left_out=of_runs, notes=tuple(f"{name}: {note}" for note in fit.notes))
    return fits | {"": whole}


def are_needed(fits: Sequence[Fit]) -> bool:
    """Whether a floor is kept, or a factor differs from 1 by more than chance, with Bonferroni's correction."""
    chances = [chance for fit in fits for chance in fit.chance]
    has_floor = any(fit.factors.floor.any() for fit in fits)
    return has_floor or len(chances) * min(chances) <= 1.0 - CONFIDENCE


def group_index(record: Record) -> Indices:
    """The group of each step, (runs, steps), -1 where it is in none: the place of a fit among those of the groups."""
    _, _, nees = stated_errors(record)
    return np.full(nees.shape, -1) if record.groups is None else record.groups.index


def by_group(fits: Mapping[str, Fit], without: int | None = None) -> ByGroup:
    """Factors of each group, and last those of all steps; ``without`` one of the fitted runs."""
    if without is None:
        return tuple(fit.factors for fit in fits.values())
    return tuple(fit.left_out[without] for fit in fits.values())


def with_factors(record: Record, used: Sequence[ByGroup]) -> Record:
    """The record with the covariances of each run corrected by its factors."""
    error, stated, _ = stated_errors(record)
    P = stated.copy()
    for run, index in enumerate(group_index(record)):
        for number in np.unique(index):
            steps = index == number
            P[run, steps] = used[run][number].applied(P[run, steps])
    return with_covariance(record, error, P)


def excess_of(record: Record, blocks: Sequence[FactorBlock], dof: Array) -> float:
    """What the uncertainty of factors known with dof (groups, B) adds to a ratio, on average over runs."""
    _, _, nees = stated_errors(record)
    sizes = np.array([len(block) for block in blocks])
    of_blocks = np.where(dof > 2.0, dof / np.maximum(dof - 2.0, 1e-9), np.inf)
    of_groups = (sizes * of_blocks).sum(axis=1) / sizes.sum()
    return average(np.where(np.isfinite(nees), of_groups[group_index(record)], np.nan))


def with_covariance(record: Record, error: Array, P: Array) -> Record:
    """The record with other errors and covariances where it had some that count."""
    _, _, stated = stated_errors(record)
    nees = np.where(np.isfinite(stated), squared_length(whiten(error, P)), np.nan)
    return record.with_errors(error, P, nees)


def with_uncertainty(record: Record, blocks: Sequence[FactorBlock], dof: Array) -> Record:
    """Corrected errors, less what the uncertainty of their factors adds.

    By a factor that is known with nu degrees of freedom the NEES of a block of n components is n times F(n, nu), not
    chi-square(n). Errors of the block are made shorter so that their NEES is the quantile of the chi-square at the same
    probability.

    Parameters
    ----------
    dof : (groups, B), nu of each block in each group
    """
    stated, P, _ = stated_errors(record)
    error = stated.copy()
    for block, of_groups in zip(blocks, dof.T, strict=True):
        nu = of_groups[group_index(record)]
        places, n = list(block.places), len(block)
        squares = squared_length(whiten(error[..., places], block.of(P)))
        known = special.chdtri(n, special.fdtrc(n, nu, squares / n))
        shorter = np.sqrt(known / np.where(squares > 0, squares, 1.0))
        is_known = np.isfinite(shorter) & (squares > 0)
        error[..., places] *= np.where(is_known, shorter, 1.0)[..., None]
    return with_covariance(record, error, P)


def verdict_of(record: Record) -> Verdict:
    """What ``analyse`` says of a record."""
    return judge_all([record])[record.name]


def held_out_by(record: Record) -> HeldOut:
    """Figures of runs beside the covariance of their record."""
    _, _, nees = stated_errors(record)
    verdict = verdict_of(record)
    if verdict.scale is not None:
        ratio = verdict.scale.inflation
    else:
        means, counts = run_means(nees)
        ratio = ratio_interval(means[counts > 0] / record.errors.dof, record.errors.dof)
    scores = [log_densities(error, P).mean() for error, P in steps_of_runs(record) if len(error)]
    return HeldOut(record, verdict, ratio, np.array(scores))


def average(values: Array) -> float:
    """Mean over runs of the mean over the steps of each, (runs, steps), NaN where there is none."""
    means, counts = run_means(values)
    return float(means[counts > 0].mean())


def correction_sentence(found: Correction) -> str:
    """The end that was reached, the ratios, and how they were found."""
    before, after = found.before.ratio, found.after.ratio
    how = f"{plural(len(found.judged), found.unit)}, each judged by the factors of the others"
    if found.held_out != IN_TURN:
        how = f"fitted on {plural(len(found.fitted), found.unit)}, judged on {len(found.judged)} others"
    parts = [f"{found.status} after: held-out covariance ratio {shown(before)} before and {shown(after)} after", how]
    if found.assumed:
        parts[0] = f"{found.status} after: none was stated; held-out covariance ratio of the one found {shown(after)}"
    if found.status == "undecided":
        decided_by = (
            f"about {plural(found.needed, found.unit)} would decide" if found.needed else found.verdict.reasons[0]
        )
        parts.append(decided_by)
    if found.status == "inconsistent":
        parts.append(f"no factor mends this: {found.verdict.reasons[0]}")
    elif not found.assumed and not found.is_needed:
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
    is_shown = (len(found.fits) > 1, True, not found.assumed, True, True, has_floors)
    factor_heads = Column("factor on variances"), Column("on sigmas", number=True)
    if found.assumed:
        factor_heads = Column("variance"), Column("sigma")
    columns = (Column("group"), Column("block"), Column("components"), *factor_heads, Column("floor, as a sigma"))
    rows = []
    for group, fit in fits.items():
        for block, factor, floor in zip(found.blocks, fit.factor, fit.floor, strict=True):
            names = " ".join(found.axes[i] for i in block.places)
            on_sigmas = f"x{short(float(np.sqrt(factor.value)))}"
            if found.assumed:
                on_sigmas = _sigma(factor, block.name)
            row = (group, block.name, names, shown(factor), on_sigmas, _sigma(floor, block.name))
            rows.append(tuple(compress(row, is_shown)))
    return table(tuple(compress(columns, is_shown)), rows, "Factors of each block", style="plain")


def _sigma(floor: Interval, block: str) -> str:
    """A floor as a standard deviation, with its unit where that is known."""
    unit = UNITS.get(next((kind for kind, axes in KINDS.items() if block in axes), block), "")
    value, low, high = np.sqrt(floor)
    return f"{value:.2g}{unit} [{low:.2g}, {high:.2g}]"


def _figures(found: Correction) -> Table:
    columns = (Column("held-out"), Column("stated"), Column("corrected"), Column("expected", number=True))
    before, after = found.before, found.after
    rows: list[tuple[str, ...]] = [("covariance ratio", shown(before.ratio), shown(after.ratio), "1")]
    for level, stated, corrected in zip(LEVELS, before.covered(LEVELS), after.covered(LEVELS), strict=True):
        rows.append((f"inside {level:.0%}", f"{stated:.1%}", f"{corrected:.1%}", f"{level:.0%}"))
    is_shown = (True, not found.assumed, True, True)
    rows = [tuple(compress(row, is_shown)) for row in rows]
    title = "Held-out errors beside the stated and the corrected covariance"
    return table(tuple(compress(columns, is_shown)), rows, title, style="plain")


def correction_lines(found: Correction) -> Iterator[str]:
    """Gain of the log score, what the uncertainty of the factors does, and limits."""
    gain = found.gain
    ends = f" [{gain.low:.3g}, {gain.high:.3g}]" if np.isfinite(gain.low) else ""
    if not found.assumed:
        yield f"log score gained a step, on average over {found.unit}s: {gain.value:.3g}{ends}"
    if len(found.fitted) < FEW and np.isfinite(found.excess) and f"{found.excess:.3g}" != "1":
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
    if found.assumed:
        yield "the covariance is diag(variance), and the same in every step of a group"
    elif len(found.fits) > 1 and not any(fit.factors.floor.any() for fit in found.shown.values()):
        yield "floors are 0 in all groups"
    else:
        yield from (note for fit in found.shown.values() for note in fit.notes)
    if found.status == "inconsistent" and len(found.blocks) < len(found.axes) and _is_one_diagonal(found.before.record):
        yield "one diagonal covariance is stated in every step; --per axis finds a variance for each component"
    yield "the factors hold for data like these; those of new conditions may be others"


def _is_one_diagonal(record: Record) -> bool:
    _, P, nees = stated_errors(record)
    stated = P[np.isfinite(nees)]
    return bool((stated == stated[0] * np.eye(record.errors.dof)).all())


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
            "convention": found.before.record.errors.convention,
            "excess": found.excess,
            "assumed": found.assumed,
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
