"""Assembly of the scale that a verdict reports."""

from __future__ import annotations

import numpy as np

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.hypothesis_tests import Tests
from consistency.referee.diagnostics.intervals import anees_interval
from consistency.referee.diagnostics.nees import anees
from consistency.referee.diagnostics.planning import detectable_ratio
from consistency.referee.diagnostics.questions import MAIN, SHARES
from consistency.referee.diagnostics.sample import Sample
from consistency.referee.diagnostics.scale import acceptance, ratio_interval
from consistency.referee.diagnostics.verdict_parts import Equivalence, Location, Scale, Settings
from consistency.referee.types import Array, Indices

NOTHING = (float("nan"), float("nan"))


def scale_of(sample: Sample, tests: Tests, settings: Settings, location: Location, shown: Equivalence) -> Scale:
    """Assemble the record of the scale; the inflation is that since the fault began, if it began late."""
    dof, means = sample.dof, sample.means()
    alive = sample.counted.sum(axis=0)
    curve, band = anees(sample.nees), pointwise_band(alive, dof)
    judged = alive > 0
    some = bool(judged.any())
    rate = SHARES[MAIN] * settings.false_alarm
    inside = (curve >= band[:, 0]) & (curve <= band[:, 1])
    of_log = None
    if len(sample.nees) == 1:
        from consistency.referee.diagnostics.single_log import within

        of_log = within(sample.nees[0], dof, settings, shown.factor)
    late = means if location.since is None else sample.means(slice(location.since - 1, None))
    return Scale(
        dof=dof,
        anees=curve,
        alive=alive,
        band=band,
        mean_anees=tests.main.ratio * dof,
        accepted=acceptance(tests.main, dof, rate, settings.allow),
        effective_dof=tests.main.effective_dof,
        inflation=ratio_interval(late, dof, CONFIDENCE),
        detectable=detectable_ratio(dof, len(means), rate, two_sided=not settings.one_sided) if some else np.nan,
        median_run=float(np.median(means)) * dof if some else np.nan,
        worst_run=float(means.max()) * dof if some else np.nan,
        share_inside=float(inside[judged].mean()) if some else np.nan,
        equivalence=shown,
        within=of_log,
    )


def pointwise_band(alive: Indices, dof: int) -> Array:
    """95 % interval of the ANEES of each single step, (steps,) -> (steps, 2); NaN without a run."""
    intervals = {int(m): anees_interval(dof, int(m), CONFIDENCE) for m in set(alive[alive > 0])}
    return np.array([intervals.get(int(m), NOTHING) for m in alive]).reshape(-1, 2)
