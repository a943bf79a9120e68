"""Search, shrink, and confirm on fresh trials: the world in which a filter is most overconfident."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from consistency.bench.challenging.search import RUNGS, Budget, Candidate, ranked, search, shrink, standard_error
from consistency.bench.challenging.world_scores import ChallengeScorer, Part, has_map
from consistency.bench.challenging.worlds import Point, Space, require_right_belief, space_of
from consistency.bench.filters import get_filter
from consistency.bench.filters.stepping import name_of
from consistency.bench.protocols import Filter
from consistency.bench.runs.montecarlo import resolve_filters, run_trials
from consistency.bench.scenario import Scenario, load_scenario
from consistency.referee.column_names import POSE
from consistency.referee.defaults import DETECT, FALSE_ALARM
from consistency.referee.diagnostics import Settings, Verdict, gate_runs
from consistency.referee.diagnostics.verdict.answers import JOINT, SCALE
from consistency.referee.errors import InputError
from consistency.referee.verdicts.options import refused
from consistency.referee.verdicts.sources import analyse

BASES = ("herath2007-stereo", "herath2007-xyz", "linear-gaussian")  # the first that a filter works on is its base
SIZE_QUESTIONS = (*SCALE, JOINT, "outliers")  # what a confirmation needs a fault in: errors that are too large
SEARCH, GO_ON, SHRINK = 0.4, 0.8, 0.8  # of the budget, spent when these end; going on if nothing is clearly wrong
CONFIRM = 0.2  # of the time, the most that the confirmation may take in a world that is searched
CHECKS = (6, 12, 24, 48)  # trials after which a smaller world is given up or kept
SURE = 2.0  # standard errors from the limit
KEPT = 0.5  # of the worst world's score that a smaller one has to keep
ENOUGH = float(np.log(5.0))  # a score that is bad enough, however bad the worst one is
EVERY = 5.0  # seconds between lines of progress


@dataclass(frozen=True)
class Plan:
    """Arguments of a challenge, and the values that follow from them before the first trial.

    Raises
    ------
    InputError
        A number out of its range.
    """

    minutes: float | None = 5.0  # None: ``trials`` count instead
    trials: int | None = None  # of search and shrinking together, at most
    seed: int = 0
    jobs: int = -1
    false_alarm: float = FALSE_ALARM  # chance that a challenge finds a right filter overconfident
    detect: float = DETECT  # ratio of true to stated covariance that the confirmation finds with a power of 95 %

    def __post_init__(self) -> None:
        if (self.minutes is None) == (self.trials is None):
            raise InputError("give either --minutes or --trials")
        if self.minutes is not None and not 0.0 < self.minutes < float("inf"):
            raise InputError(f"--minutes must be a positive number, got {self.minutes}")
        if self.trials is not None and self.trials < RUNGS[0]:
            raise InputError(f"--trials must be at least {RUNGS[0]}, got {self.trials}")
        if self.seed < 0:
            raise InputError(f"--seed must not be negative, got {self.seed}")
        if not self.detect > 1.0:
            raise InputError(f"--detect must be a ratio above 1, got {self.detect}")
        _ = self.runs

    @property
    def runs(self) -> int:
        """Runs of the confirmation: as many as a verdict takes to find the ratio ``detect``."""
        try:
            return gate_runs(len(POSE), self.detect, self.false_alarm)
        except ValueError as error:
            raise refused(error) from None

    @property
    def seeds(self) -> tuple[int, int, int]:
        """Seeds of the search, of shrinking and of the confirmation; no two phases share a trial."""
        search_, shrink_, confirm_ = np.random.SeedSequence(self.seed).generate_state(3)
        return int(search_), int(shrink_), int(confirm_)


@dataclass(frozen=True)
class Challenge:
    """Result of a challenge. ``world`` is the tested world: the smallest one, or if not ``clear`` the worst one."""

    filter: str
    part: Part  # of the estimates, whose covariance was challenged
    plan: Plan
    space: Space
    worst: Point  # the most overconfident world of the search
    worst_ratio: float  # true over stated covariance there, in a typical run
    clear: bool  # that world is clearly overconfident, so that smaller ones were looked for
    point: Point  # of ``world``
    world: Scenario
    verdict: Verdict  # on fresh trials
    worlds: int  # that were tried
    trials: int  # that were run, those of the confirmation aside
    unusable: int  # worlds that do not exist, show no landmark, or take too long
    seconds: float

    @property
    def found(self) -> bool:
        """Was the filter found overconfident? With probability ``plan.false_alarm`` or less if it is right."""
        return is_overconfident(self.verdict)

    @property
    def p_value(self) -> float:
        """False-alarm rate at which the errors would just be found too large, all questions together; NaN if none."""
        adjusted = [a.adjusted for a in self.verdict.answers if a.question in SIZE_QUESTIONS]
        return min(adjusted, default=float("nan"))


def is_overconfident(verdict: Verdict) -> bool:
    """Are the errors larger than the covariance says, or did a run break down?

    The mean NEES lies above its degrees of freedom, 3 of a pose or of a landmark in space, and a question about the
    size of the errors found a fault. The referee finds a fault in any question with probability ``false_alarm`` or less
    if the covariance is right. A breakdown is a fact and needs no test.
    """
    if verdict.failures or verdict.status == "failed":
        return True
    return verdict.inflation > 1.0 and any(question in SIZE_QUESTIONS for question in verdict.faults)


def challenge(
    filter_: str | Filter,
    base: str | Scenario | None = None,
    plan: Plan | None = None,
    within: Sequence[str] = (),
    part: Part = "pose",
) -> Challenge:
    """Look for the world in which a filter is most overconfident, and confirm it on fresh trials.

    Exactly one confirmation is made, of a number of runs that is fixed beforehand, with seeds that the search has not
    used. So a filter that is right in every world is found overconfident with probability ``plan.false_alarm`` or less,
    however long the search was. What is found depends on the seed and, unless ``plan.trials`` is given, on the time.

    Parameters
    ----------
    base : the scenario whose values are the plain ones; None for the first of :data:`BASES` that fits the filter
    within : bounds of dimensions, see ``consistency.bench.challenging.worlds.space_of``
    part : whose covariance is challenged, that of the pose in all steps or that of the map at the end, given the pose

    Raises
    ------
    InputError
        Unknown filter or scenario, one that does not fit the other, bounds that hold no world, or no map.
    """
    plan = Plan() if plan is None else plan
    instance, scenario = opponents(filter_, base)
    if part == "map" and not has_map(instance, scenario):
        raise InputError(f"filter '{name_of(instance)}': states no covariance of pose and map; use --of pose")
    space = space_of(scenario, within)
    with ChallengeScorer(instance, plan.jobs, part) as bench:
        bench.compile(corners(space))
        return ChallengePhases(bench, space, plan).run()


def challenge_parts(
    filter_: str | Filter, base: str | Scenario | None = None, plan: Plan | None = None, within: Sequence[str] = ()
) -> tuple[Challenge, Challenge | None]:
    """A challenge of the pose and one of the map, each with half of the time; of the pose alone where there is no map.

    Each is a challenge by itself, with its own confirmation, and finds a right covariance too small with probability
    ``plan.false_alarm`` or less. See :func:`challenge` for parameters and errors.
    """
    plan = Plan() if plan is None else plan
    instance, scenario = opponents(filter_, base)
    if not has_map(instance, scenario):
        return challenge(instance, scenario, plan, within), None
    minutes = None if plan.minutes is None else plan.minutes / 2
    half = replace(plan, minutes=minutes, trials=None if plan.trials is None else max(RUNGS[0], plan.trials // 2))
    pose, map_ = (challenge(instance, scenario, half, within, part) for part in ("pose", "map"))
    return pose, map_


def opponents(filter_: str | Filter, base: str | Scenario | None) -> tuple[Filter, Scenario]:
    """The filter, and the scenario from which its worlds differ; raises InputError."""
    instance = get_filter(filter_) if isinstance(filter_, str) else filter_
    scenario = base_of(instance) if base is None else load_scenario(base) if isinstance(base, str) else base
    resolve_filters([instance], scenario.belief)
    require_right_belief(scenario)
    return instance, scenario


def base_of(filter_: Filter) -> Scenario:
    """The scenario to start from if none is named."""
    sensors = getattr(filter_, "sensors", None)
    for name in BASES:
        scenario = load_scenario(name)
        if sensors is None or scenario.belief.sensor.model in sensors:
            return scenario
    raise InputError(f"filter '{name_of(filter_)}': no scenario is known for its sensor; name one with --scenario")


def corners(space: Space) -> list[Scenario]:
    """Worlds that need all the kernels there are: that of the base, and those with few and many landmarks in view."""
    few = tuple(d.at(0.0) if d.name == "density" else d.plain for d in space.dimensions)
    many = tuple(d.at(1.0) if d.name in ("density", "range") else d.plain for d in space.dimensions)
    return [scenario for point in (space.plain, few, many) if (scenario := scenario_of(space, point)) is not None]


def scenario_of(space: Space, point: Point) -> Scenario | None:
    try:
        return space.world(point)
    except ValueError:
        return None


class ChallengePhases:
    """One challenge: the counts, and the phases in order."""

    def __init__(self, bench: ChallengeScorer, space: Space, plan: Plan) -> None:
        self.bench, self.space, self.plan = bench, space, plan
        self.search_seed, self.shrink_seed, self.confirm_seed = plan.seeds
        self.budget = Budget(None if plan.minutes is None else 60.0 * plan.minutes, plan.trials)
        seconds = self.budget.seconds
        self.slowest = np.inf if seconds is None else CONFIRM * seconds * bench.workers / plan.runs  # for one trial
        self.tried: dict[Point, Candidate] = {}
        self.checked: dict[Point, list[float]] = {}
        self.unusable = set[Point]()
        self.told = time.monotonic()

    def run(self) -> Challenge:
        name, plan = name_of(self.bench.filter), self.plan
        point, limit = worst, _ = self.search()
        if limit is not None:
            self.tell("shrinking", now=True)
            point = shrink(self.space, worst, lambda p: self.holds(p, limit), partial(self.budget.left, SHRINK))
        self.tell(f"confirming on {plan.runs} fresh runs", now=True)
        part = self.bench.part
        world = self.space.world(point, f"challenge-{name}" + ("-map" if part == "map" else ""))
        results = run_trials(world, [self.bench.filter], plan.runs, self.confirm_seed, plan.jobs)
        verdict = analyse(results, settings=Settings(plan.false_alarm))[name]
        if part == "map" and verdict.map is not None:  # without a map every run failed
            verdict = verdict.map.verdict or verdict
        return Challenge(
            name, part, plan, self.space, worst, np.exp(np.mean(self.checked.get(worst) or self.tried[worst].scores)),
            limit is not None, point, world, verdict, len({*self.tried, *self.checked} - self.unusable),
            self.budget.used, len(self.unusable), self.budget.elapsed,
        )  # fmt: skip

    def search(self) -> tuple[Point, float | None]:
        """The worst point, and the mean score that smaller ones must keep; None if it is not clearly overconfident."""
        rng = np.random.default_rng(self.search_seed)
        for share in (SEARCH, GO_ON):  # nothing clearly wrong: more search is worth more than shrinking
            search(self.space, self.evaluate, partial(self.budget.left, share), rng, self.tried)
            usable = ranked(self.tried.values())
            if not usable:
                raise InputError(
                    f"scenario '{self.space.base.name}': no world within the bounds can be tried in this time; widen "
                    "--within, give more --minutes or another --scenario"
                )
            worst = usable[0].point
            scores = self.check(worst, CHECKS[-1])
            limit = max(float(np.log(self.plan.detect)), min(KEPT * float(np.mean(scores or 0.0)), ENOUGH))
            if self.holds(worst, limit):
                return worst, limit
        return worst, None

    def evaluate(self, candidates: Sequence[Candidate], trials: int) -> None:
        """Give candidates trials up to this number in all."""
        ready = []
        for candidate in candidates:
            world = scenario_of(self.space, candidate.point)
            self._mark(candidate, world is not None)
            ready += [] if world is None else [(candidate, (world, range(len(candidate.scores), trials)))]
        until = self.budget.until(GO_ON)
        for (candidate, _), done in zip(
            ready, self.bench([job for _, job in ready], self.search_seed, until), strict=True
        ):
            self._mark(candidate, done is not None and done.seconds <= self.slowest)
            candidate.scores += [] if done is None else done.scores
            self.budget.used += 0 if done is None else len(done.scores)
        self.tell("searching")

    def _mark(self, candidate: Candidate, usable: bool) -> None:
        candidate.usable = usable
        if not usable:
            self.unusable.add(candidate.point)

    def check(self, point: Point, trials: int) -> list[float]:
        """Scores of a point on trials that the search has not seen, up to this number or the end of the time."""
        scores = self.checked.setdefault(point, [])
        world = scenario_of(self.space, point)
        if world is not None and len(scores) < trials:
            jobs = self.bench.split(world, range(len(scores), trials))
            for done in self.bench(jobs, self.shrink_seed, self.budget.until(SHRINK)):
                if done is None or done.seconds > self.slowest:
                    self.unusable.add(point)
                scores += [] if done is None else done.scores
                self.budget.used += 0 if done is None else len(done.scores)
        return scores

    def holds(self, point: Point, limit: float) -> bool:
        """Is the mean score of a point clearly at the limit or above?"""
        for trials in CHECKS:
            scores = self.check(point, trials)
            self.tell("shrinking")
            if len(scores) < trials or point in self.unusable:
                return False
            error = SURE * standard_error(scores)
            if np.mean(scores) + error < limit:
                return False
            if np.mean(scores) - 2.0 * error >= limit:
                return True
        return bool(np.mean(scores) - error >= limit)

    def tell(self, what: str, now: bool = False) -> None:
        """A line of progress, every few seconds."""
        if now or time.monotonic() - self.told >= EVERY:
            self.told = time.monotonic()
            worlds, trials = len(self.tried), self.budget.used
            print(
                f"{self.bench.part}, {what}: {self.budget.elapsed:.0f} s, {worlds} worlds, {trials} trials",
                file=sys.stderr, flush=True,
            )  # fmt: skip
