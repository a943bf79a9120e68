"""Which filters to trust on one rig: what the map says of the cells around it, and a few runs of the rig itself."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from consistency.bench.runs.montecarlo import run_trials
from consistency.bench.sweeps.cell import CellResult
from consistency.bench.sweeps.plan import Cell, text_of
from consistency.bench.sweeps.regime import Regime, ranked
from consistency.bench.sweeps.rig import ALIKE, AxisPlace, Request, Rig, differences, distance, place_on, read_rig
from consistency.referee.diagnostics import Verdict
from consistency.referee.errors import InputError
from consistency.referee.terminal.progress import quiet
from consistency.referee.verdicts.judge import analyse

MOST = 2  # filters that are confirmed: each may have to be compiled
OPEN = ("consistent", "undecided")  # what confirming runs say where they find no fault
SURENESS = {
    "sure": "the rig lies inside the map, all cells around it agree, and runs of the rig itself find no fault",
    "fairly sure": "the nearest cell says so, but not everything else does",
    "unsure": "the map does not reach this rig",
    "no": "runs of the rig itself contradict the map",
}


@dataclass(frozen=True)
class NearFilter:
    """A filter as the map has it near the rig."""

    filter: str
    nearest: CellResult  # in the cell nearest to the rig
    agreeing: int  # cells around the rig in which it is consistent
    around: int  # cells around the rig; one that the map does not have yet does not agree
    verdict: Verdict | None = None  # of the confirming runs
    sure: str = ""  # one of SURENESS; empty: not to be trusted by the map

    @property
    def trusted(self) -> bool:
        return self.sure not in ("", "no")

    @property
    def detectable(self) -> float:
        """Smallest ratio of true to stated covariance that the confirming runs find with power 0.95; NaN without."""
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
    runs: int  # confirming runs
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
    request: Request, regime: Regime, runs: int = 24, confirm: int = MOST, seed: int = 0, jobs: int = -1
) -> Advice:
    """Look a rig up in a map, and confirm the best filters by runs of the rig.

    Parameters
    ----------
    runs : confirming runs of each filter; 0 for none
    confirm : filters to confirm, 0 to 2

    Raises
    ------
    InputError
        An unusable rig or option, or a map without the cells around the rig.
    """
    if not 0 <= confirm <= MOST:
        raise InputError(f"--confirm {confirm}: must be 0, 1 or {MOST}")
    if runs < 0 or runs == 1:
        raise InputError(f"--runs {runs}: must be 0, or 2 or more")
    sweep = regime.sweep
    rig = read_rig(request, sweep.base)
    places = tuple(place_on(axis, axis.of(rig.scenario, sweep.base)) for axis in sweep.axes)
    nearest = _cell(regime, [place.nearest for place in places])
    around = [_cell(regime, at) for at in itertools.product(*(place.around for place in places))]
    candidates = candidates_of(regime, nearest, around)
    if not candidates:
        raise InputError(f"the map has nothing of {nearest.text}; finish its sweep first")
    good = [candidate.filter for candidate in candidates if candidate.nearest.status == "consistent"]
    names, verdicts = good[:confirm] if runs else [], {}
    if names:
        with quiet():
            results = run_trials(rig.scenario, names, runs, seed, jobs)
        verdicts = analyse(results, names, settings=sweep.rule.settings)
    unlike = tuple(differences(rig.scenario, sweep))
    inside = all(place.inside for place in places)
    known = tuple(_judged(candidate, verdicts, inside, not unlike) for candidate in candidates)
    elsewhere = "" if good else _elsewhere(regime, places)
    return Advice(rig, regime, places, nearest, _sorted(known), unlike, runs if names else 0, elsewhere)


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


def _judged(candidate: NearFilter, verdicts: Mapping[str, Verdict], inside: bool, alike: bool) -> NearFilter:
    """How sure it is that the candidate is consistent on the rig."""
    if candidate.nearest.status != "consistent":
        return candidate
    verdict = verdicts.get(candidate.filter)
    if verdict is not None and verdict.status not in OPEN:
        sure = "no"
    elif not inside:
        sure = "unsure"
    elif verdict is not None and alike and candidate.agreeing == candidate.around:
        sure = "sure"
    else:
        sure = "fairly sure"
    return replace(candidate, verdict=verdict, sure=sure)


def _sorted(candidates: Sequence[NearFilter]) -> tuple[NearFilter, ...]:
    """Contradicted filters behind those that stand, confirmed ones before the others; else as they are."""
    return tuple(sorted(candidates, key=lambda c: (not c.sure, c.sure == "no", c.sure != "" and c.verdict is None)))


def _elsewhere(regime: Regime, places: tuple[AxisPlace, ...]) -> str:
    """The nearest cell where a filter is consistent, in words; empty where there is none."""
    cells = [(distance(places, cell), cell, regime.trusted(cell)) for cell in regime.sweep.cells]
    found = min((entry for entry in cells if entry[2]), key=lambda entry: entry[0], default=None)
    if found is None:
        return ""
    _, cell, trusted = found
    return f"{text_of(regime.sweep.axes, cell.indices)}: {', '.join(name for name, _ in trusted)}"
