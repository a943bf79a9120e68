"""Which filter to trust on one rig: what the map says of the cells around it, and runs of the rig itself."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from consistency.bench.runs.montecarlo import run_trials
from consistency.bench.sweeps.cell import CellResult
from consistency.bench.sweeps.plan import Cell, Sweep, text_of
from consistency.bench.sweeps.regime import Regime, ranked
from consistency.bench.sweeps.rig import ALIKE, AxisPlace, Request, Rig, differences, distance, place_on, read_rig
from consistency.referee.diagnostics import Verdict, gate_runs
from consistency.referee.errors import InputError
from consistency.referee.parsing.columns import POSE
from consistency.referee.verdicts.judge import analyse

CONFIRM = 4  # filters that are confirmed at most: each may have to be compiled
OPEN = ("consistent", "undecided")  # what confirming runs say where they find no fault
SURENESS = {
    "sure": "the rig lies inside the map, all cells around it agree, and runs of the rig show the filter consistent",
    "fairly sure": "the nearest cell says so, but not everything else does",
    "unsure": "the map does not reach this rig",
    "no": "runs of the rig itself contradict the map",
    "": "not consistent in the nearest cell, or not run on the rig",
}


@dataclass(frozen=True)
class NearFilter:
    """A filter as the map has it near the rig."""

    filter: str
    nearest: CellResult  # in the cell nearest to the rig
    agreeing: int  # cells around the rig in which it is consistent
    around: int  # cells around the rig; one that the map does not have yet does not agree
    verdict: Verdict | None = None  # of the confirming runs
    sure: str = ""  # one of SURENESS

    @property
    def trusted(self) -> bool:
        return self.sure not in ("", "no")

    @property
    def detectable(self) -> float:
        """Smallest ratio of true to stated covariance that the runs find with the map's power; NaN without runs."""
        scale = None if self.verdict is None else self.verdict.scale
        return float("nan") if scale is None else scale.detectable


@dataclass(frozen=True)
class Advice:
    """What can be said of one rig."""

    rig: Rig
    regime: Regime
    places: tuple[AxisPlace, ...]
    nearest: Cell
    candidates: tuple[NearFilter, ...]  # the best first
    unlike: tuple[str, ...]  # keys in which no cell of the map is as the rig is
    runs: int  # confirming runs of each filter; 0: the map alone was asked
    elsewhere: str  # the nearest cell with a filter to trust, where there is none here

    @property
    def inside(self) -> bool:
        return all(place.inside for place in self.places)

    @property
    def lacking(self) -> tuple[str, ...]:
        """Filters that the map, of a sweep that is not finished, does not have in the nearest cell."""
        there = {candidate.filter for candidate in self.candidates}
        return tuple(name for name in self.regime.sweep.filters if name not in there)

    @property
    def untried(self) -> tuple[str, ...]:
        """Filters that the map has as consistent here and that were not run, though runs were asked for."""
        good = [c.filter for c in self.candidates if c.nearest.status == "consistent" and c.verdict is None]
        return tuple(good) if self.runs else ()

    @property
    def best(self) -> NearFilter | None:
        """The filter to take; None where none is to be trusted."""
        return next((candidate for candidate in self.candidates if candidate.trusted), None)

    @property
    def equivalent(self) -> tuple[float, float] | None:
        """Baseline of the rig and the one that it counts as (m), where they differ."""
        sensor_rig = self.rig.scenario.truth.sensor.rig
        counted = next((float(place.value) for place in self.places if place.axis.key == "baseline"), None)
        if sensor_rig is None or counted is None or abs(counted / sensor_rig[1] - 1.0) < ALIKE:
            return None
        return sensor_rig[1], counted


def recommend_for(
    request: Request, regime: Regime, runs: int | None = None, confirm: int = CONFIRM, seed: int = 0, jobs: int = -1
) -> Advice:
    """Look a rig up in a map, and confirm filters by runs of the rig, the best first, until one is not contradicted.

    Parameters
    ----------
    runs : confirming runs of each filter, by default as many as the rule of the map needs; 0 for the
        map alone
    confirm : filters to confirm, at most

    Raises
    ------
    InputError
        An unusable rig or option, or a map without the cells around the rig.
    """
    if confirm < 1:
        raise InputError(f"--confirm {confirm}: must be at least 1; for the map alone, without a run, give --runs 0")
    sweep = regime.sweep
    runs = runs_of(sweep) if runs is None else runs
    if runs < 0 or runs == 1:
        raise InputError(f"--runs {runs}: must be 0, or 2 or more")
    rig = read_rig(request, sweep.base)
    places = tuple(place_on(axis, axis.of(rig.scenario, sweep.base)) for axis in sweep.axes)
    nearest = _cell(regime, [place.nearest for place in places])
    candidates = candidates_of(regime, nearest, [_cell(regime, at) for at in around(places)])
    if not candidates:
        raise InputError(f"the map has nothing of {nearest.text}; finish its sweep first")
    unlike = tuple(differences(rig.scenario, sweep))
    inside = all(place.inside for place in places)
    left, known = confirm if runs else 0, []
    for candidate in candidates:
        if left and candidate.nearest.status == "consistent":
            results = run_trials(rig.scenario, [candidate.filter], runs, seed, jobs)
            (verdict,) = analyse(results, [candidate.filter], settings=sweep.rule.settings).values()
            candidate = replace(candidate, verdict=verdict)
            left = 0 if verdict.status in OPEN else left - 1
        known.append(replace(candidate, sure=sureness(candidate, inside, not unlike, alone=runs == 0)))
    elsewhere = "" if any(c.nearest.status == "consistent" for c in known) else _elsewhere(regime, places)
    return Advice(rig, regime, places, nearest, _sorted(known), unlike, runs, elsewhere)


def runs_of(sweep: Sweep) -> int:
    """Runs that suffice for a verdict by the rule of the map: its fault is found, or its absence shown."""
    rule = sweep.rule
    return gate_runs(len(POSE), rule.detect, rule.false_alarm, rule.power)


def around(places: Sequence[AxisPlace]) -> list[tuple[int, ...]]:
    """Corners of the box in which a rig lies, and the neighbours of the nearest cell on each axis."""
    nearest = tuple(place.nearest for place in places)
    found = list(itertools.product(*(place.around for place in places)))
    for k, place in enumerate(places):
        beside = (i for i in (nearest[k] - 1, nearest[k] + 1) if 0 <= i < len(place.axis.values) and place.axis.numeric)
        found += [(*nearest[:k], i, *nearest[k + 1 :]) for i in beside]
    return list(dict.fromkeys(found))


def _cell(regime: Regime, at: Sequence[int]) -> Cell:
    sweep = regime.sweep
    number = int(np.ravel_multi_index(tuple(at), tuple(len(axis.values) for axis in sweep.axes)))
    return sweep.cell(number, tuple(at))


def candidates_of(regime: Regime, nearest: Cell, around: Sequence[Cell]) -> list[NearFilter]:
    """Filters by what the map says: consistent in the nearest cell, in all cells around, then RMSE and cost."""
    here, cells = regime.at(nearest), [regime.at(cell) for cell in around]
    found = []
    for name, result in ranked(here):
        near = [results[name].status == "consistent" for results in cells if name in results]
        found.append(NearFilter(name, result, sum(near), len(cells)))
    return sorted(found, key=lambda c: (c.nearest.status != "consistent", c.agreeing < c.around))


def sureness(candidate: NearFilter, inside: bool, alike: bool, alone: bool = False) -> str:
    """How sure it is that the candidate is consistent on the rig; ``alone``: the map was asked without runs."""
    verdict = candidate.verdict
    if candidate.nearest.status != "consistent" or (verdict is None and not alone):
        return ""
    if verdict is not None and verdict.status not in OPEN:
        return "no"
    if not (inside and alike):
        return "unsure"
    shown = verdict is not None and verdict.status == "consistent"
    return "sure" if shown and candidate.agreeing == candidate.around else "fairly sure"


def _sorted(candidates: Sequence[NearFilter]) -> tuple[NearFilter, ...]:
    """Those to be trusted first, then those that the runs contradict; else as they are."""
    return tuple(sorted(candidates, key=lambda c: (not c.trusted, c.sure != "no")))


def _elsewhere(regime: Regime, places: tuple[AxisPlace, ...]) -> str:
    """The nearest cell where a filter is consistent, in words; empty where there is none."""
    cells = [(distance(places, cell), cell, regime.trusted(cell)) for cell in regime.sweep.cells]
    found = min((entry for entry in cells if entry[2]), key=lambda entry: entry[0], default=None)
    if found is None:
        return ""
    _, cell, trusted = found
    return f"{text_of(regime.sweep.axes, cell.indices)}: {', '.join(name for name, _ in trusted)}"
