"""Which filter to trust on one rig: what the map says of the cells around it, and runs of the rig itself."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

from consistency.bench.runs.montecarlo import run_trials
from consistency.bench.sweeps.cell import CellResult
from consistency.bench.sweeps.plan import Cell, text_of
from consistency.bench.sweeps.regime import Regime, ranked
from consistency.bench.sweeps.rig import (
    ALIKE,
    AT,
    AxisPlace,
    Request,
    Rig,
    differences,
    distance,
    is_known,
    place_on,
    read_rig,
)
from consistency.referee.column_names import POSE
from consistency.referee.diagnostics import Settings, Verdict, gate_runs
from consistency.referee.errors import InputError
from consistency.referee.verdicts.sources import analyse

CONFIRM = 4  # filters that are confirmed at most: each may have to be compiled
OPEN = ("consistent", "undecided")  # what confirming runs say where they find no fault


@dataclass(frozen=True)
class NearFilter:
    """A filter as the map has it near the rig."""

    filter: str
    nearest: CellResult  # in the cell nearest to the rig
    agreeing: int  # cells around the rig in which it is consistent
    around: int  # cells around the rig; one that the map does not have yet does not agree
    verdict: Verdict | None = None  # of the confirming runs
    sure: str = ""  # sure | fairly sure | unsure | no: the runs find a fault | "": not consistent in the nearest cell
    beyond: CellResult | None = None  # in the nearest cell of the second map, where that is looked at

    @property
    def is_near(self) -> bool:
        """Whether it is consistent in the nearest cells."""
        return all(found.status == "consistent" for found in (self.nearest, self.beyond) if found is not None)

    @property
    def trusted(self) -> bool:
        return self.sure not in ("", "no")

    @property
    def detectable(self) -> float:
        """Smallest ratio of true to stated covariance that the runs find with the map's power; NaN without runs."""
        scale = None if self.verdict is None else self.verdict.scale
        return float("nan") if scale is None else scale.detectable


@dataclass(frozen=True)
class MapPlace:
    """Where a rig lies in a map."""

    regime: Regime
    places: tuple[AxisPlace, ...]
    nearest: Cell
    around: tuple[Cell, ...]
    unlike: tuple[str, ...]  # keys in which no cell of the map is as the rig is

    @property
    def outside(self) -> set[str]:
        """Axes beyond whose ends the rig lies."""
        return {place.axis.key for place in self.places if not place.inside}


@dataclass(frozen=True)
class Advice:
    """What can be said of one rig."""

    rig: Rig
    here: MapPlace  # in the map
    beyond: MapPlace | None  # in the map of axes that vary alone, if the rig differs in one of these
    candidates: tuple[NearFilter, ...]  # the best first
    unlike: tuple[str, ...]  # keys in which no cell of a map is as the rig is
    inside: bool
    runs: int  # confirming runs of each filter; 0: the map alone was asked
    elsewhere: str  # the nearest cell with a filter to trust, where there is none here

    @property
    def lacking(self) -> tuple[str, ...]:
        """Filters that the map, of a sweep that is not finished, does not have in the nearest cell."""
        there = {candidate.filter for candidate in self.candidates}
        return tuple(name for name in self.here.regime.sweep.filters if name not in there)

    @property
    def untried(self) -> tuple[str, ...]:
        """Filters that the map has as consistent here and that were not run, though runs were asked for."""
        good = [c.filter for c in self.candidates if c.is_near and c.verdict is None]
        return tuple(good) if self.runs else ()

    @property
    def best(self) -> NearFilter | None:
        """The filter to take; None where none is to be trusted."""
        return next((candidate for candidate in self.candidates if candidate.trusted), None)

    @property
    def equivalent(self) -> tuple[float, float] | None:
        """Baseline of the rig and the one that it counts as (m), where they differ."""
        sensor_rig = self.rig.scenario.truth.sensor.rig
        counted = next((float(place.value) for place in self.here.places if place.axis.key == "baseline"), None)
        if sensor_rig is None or counted is None or abs(counted / sensor_rig[1] - 1.0) < ALIKE:
            return None
        return sensor_rig[1], counted


def recommend_for(
    request: Request,
    regime: Regime,
    runs: int | None = None,
    confirm: int = CONFIRM,
    seed: int = 0,
    jobs: int = -1,
    alone: Regime | None = None,
) -> Advice:
    """Look a rig up in a map, and confirm filters by runs of the rig, the best first, until one is not contradicted.

    Parameters
    ----------
    runs : confirming runs of each filter, by default as many as the rule of the map needs; 0 for the
        map alone
    confirm : filters to confirm, at most
    alone : a map of axes that vary one at a time, for a rig that lies beyond the other one

    Raises
    ------
    InputError
        An unusable rig or option, or a map without the cells around the rig.
    """
    if confirm < 1:
        raise InputError(f"--confirm {confirm}: must be at least 1; for the map alone, without a run, give --runs 0")
    sweep, rule = regime.sweep, regime.sweep.rule
    if runs is None:  # its fault is found, or its absence shown
        runs = gate_runs(len(POSE), rule.detect, rule.false_alarm, rule.power)
    if runs < 0 or runs == 1:
        raise InputError(f"--runs {runs}: must be 0, or 2 or more")
    rig = read_rig(request, sweep.base)
    here = place_in(regime, rig)
    if here is None:
        raise InputError("the map varies one axis at a time, and the rig differs in more; give a map of a grid first")
    beyond = None if alone is None else beyond_of(here, alone, rig)
    candidates = candidates_of(here, beyond)
    if not candidates:
        raise InputError(f"the map has nothing of {here.nearest.text}; finish its sweep first")
    unlike, outside = _left(here, beyond)
    left, known, settings = confirm if runs else 0, [], Settings(rule.false_alarm, rule.detect, rule.power)
    for candidate in candidates:
        if left and candidate.is_near:
            results = run_trials(rig.scenario, [candidate.filter], runs, seed, jobs)
            (verdict,) = analyse(results, [candidate.filter], settings=settings).values()
            candidate = replace(candidate, verdict=verdict)
            left = 0 if verdict.status in OPEN else left - 1
        alike = not unlike and (beyond is None or candidate.beyond is not None)
        known.append(replace(candidate, sure=sureness(candidate, not outside, alike, alone=runs == 0)))
    elsewhere = "" if any(c.is_near for c in known) else _elsewhere(regime, here.places)
    return Advice(rig, here, beyond, _sorted(known), unlike, not outside, runs, elsewhere)


def place_in(regime: Regime, rig: Rig, known: Collection[str] = ()) -> MapPlace | None:
    """Where a rig lies in a map; None where it differs on two axes of those that vary alone.

    Parameters
    ----------
    known : axes that another map has; on them the rig counts as the base of this one, if they vary alone here
    """
    sweep, places = regime.sweep, list[AxisPlace]()
    for axis in sweep.axes:
        value = axis.of(rig.scenario, sweep.base)
        if axis.home is not None and (axis.key in known or not is_known(value)):
            value = axis.values[axis.home]  # one that is not known is among the differences
        places.append(place_on(axis, value))
    away = [p for p in places if p.axis.home is not None and abs(p.position - p.axis.home) >= AT]
    nearest = None if len(away) > 1 else sweep.at([place.nearest for place in places])
    if nearest is None:
        return None
    cells = (sweep.at(at) for at in around(places))
    near = tuple(cell for cell in cells if cell is not None)
    return MapPlace(regime, tuple(places), nearest, near, tuple(differences(rig.scenario, sweep)))


def beyond_of(here: MapPlace, alone: Regime, rig: Rig) -> MapPlace | None:
    """The rig's place in the second map; None where it differs in nothing that this one varies."""
    base, model = alone.sweep.base, rig.scenario.truth.sensor.model
    if base.truth.sensor.model != model:
        raise InputError(f"--map: the second map is of sensors '{base.truth.sensor.model}', the first of '{model}'")
    inside = [place.axis.key for place in here.places if place.inside]
    found = place_in(alone, rig, inside)
    if found is None:
        return None
    covered = here.outside & ({place.axis.key for place in found.places} - found.outside)
    return found if covered or not set(here.unlike) <= set(found.unlike) else None


def _left(here: MapPlace, beyond: MapPlace | None) -> tuple[tuple[str, ...], set[str]]:
    """Keys in which no cell of either map is as the rig is, and axes beyond the ends of which it lies."""
    if beyond is None:
        return here.unlike, here.outside
    varied = {place.axis.key for place in beyond.places if place.axis.home is not None}
    unlike = tuple(key for key in here.unlike if key in beyond.unlike)
    return unlike, (here.outside - varied) | beyond.outside


def around(places: Sequence[AxisPlace]) -> list[tuple[int, ...]]:
    """Corners of the box in which a rig lies, and the neighbours of the nearest cell on each axis."""
    nearest = tuple(place.nearest for place in places)
    found = list(itertools.product(*(place.around for place in places)))
    for k, place in enumerate(places):
        beside = (i for i in (nearest[k] - 1, nearest[k] + 1) if 0 <= i < len(place.axis.values) and place.axis.numeric)
        found += [(*nearest[:k], i, *nearest[k + 1 :]) for i in beside]
    return list(dict.fromkeys(found))


def candidates_of(here: MapPlace, beyond: MapPlace | None = None) -> list[NearFilter]:
    """Filters by what the maps say: consistent in the nearest cell, in all cells around, then RMSE and cost."""
    found, at = here.regime.at(here.nearest), [place for place in (here, beyond) if place is not None]
    there = {} if beyond is None else beyond.regime.at(beyond.nearest)
    cells = [place.regime.at(cell) for place in at for cell in place.around]
    candidates = []
    for name, _ in ranked(found | {name: result for name, result in there.items() if name in found}):
        near = [results[name].status == "consistent" for results in cells if name in results]
        candidates.append(NearFilter(name, found[name], sum(near), len(cells), beyond=there.get(name)))
    return sorted(candidates, key=lambda c: (not c.is_near, c.agreeing < c.around))


def sureness(candidate: NearFilter, inside: bool, alike: bool, alone: bool = False) -> str:
    """How sure it is that the candidate is consistent on the rig; ``alone``: the map was asked without runs."""
    verdict = candidate.verdict
    if not candidate.is_near or (verdict is None and not alone):
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
