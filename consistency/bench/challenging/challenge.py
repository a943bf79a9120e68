"""The world in which a filter is most overconfident: a search over scores of trials, and one test on fresh trials.

Points come in batches. The first batch, and a quarter of each later one, fills the unit cube evenly (Halton's
sequence); the rest varies the best points so far by differential mutation and crossover (Storn & Price 1997). A batch
is raced by successive halving (Jamieson & Talwalkar 2016): two trials for each point, twice as many for the better
half, and so on. Awad, Mallik & Hutter (2021) combine the two likewise. Mixed dimensions need nothing of their own: all
are places in the unit cube.

The sampler is SciPy's. Its optimisers know neither noise nor evaluations that are broken off, and Hypothesis'
``target`` has no time limit.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import qmc

from consistency.bench.challenging.world_space import Point, Space, require_right_belief, space_of
from consistency.bench.filters import get_filter
from consistency.bench.filters.compiled import one_blas_thread
from consistency.bench.filters.run_filter import resolve_filters
from consistency.bench.protocols import Filter, name_of
from consistency.bench.runs.isolation import Isolation
from consistency.bench.runs.montecarlo import run_trials
from consistency.bench.runs.results_to_records import analyse
from consistency.bench.runs.run_outcome import compile_all, first_trials, outcome_of
from consistency.bench.runs.workers import worker_count
from consistency.bench.scenario import Scenario, load_scenario, scenario_text
from consistency.bench.simulation import World, require_landmarks_in_view
from consistency.referee.column_names import POSE
from consistency.referee.defaults import DETECT, FALSE_ALARM
from consistency.referee.diagnostics.number_of_runs import gate_runs
from consistency.referee.diagnostics.number_words import p_text
from consistency.referee.diagnostics.verdict import Verdict, plain
from consistency.referee.diagnostics.verdict_parts import JOINT, SCALE, Settings
from consistency.referee.errors import InputError
from consistency.referee.system import write_whole, writing
from consistency.referee.types import Array
from consistency.referee.verdicts.judge_sources import refused

BASES = ("herath2007-stereo", "herath2007-xyz", "linear-gaussian")  # the first that a filter works on is its base
SIZE_QUESTIONS = (*SCALE, JOINT, "outliers")  # what a confirmation needs a fault in: errors that are too large
SEARCH = 0.8  # share of the budget that is spent on the search
CONFIRM = 0.2  # of the time, the most that the confirmation may take in a world that is searched
EVERY = 5.0  # seconds between lines of progress
WORST = float(np.log(1e4))  # of a run that failed, and the most of one that did not
PATIENCE = 60.0  # s beyond the end of the search, after which a trial of a filter that is not compiled is killed
Job = tuple[Scenario, Sequence[int]]  # a world, and the trials in it
BATCH = 16  # points raced against each other
RUNGS = (2, 4, 8, 16)  # trials of a point in all, at each of which the worse half is left behind
HOPELESS = 8 * BATCH  # points none of which is usable: there will be no other
ELITE = 8  # points that are varied
EVEN = 4  # points of a batch that fill the space
STEP, CROSSOVER, JITTER = 0.7, 0.5, 0.05  # of the variation; the first two within the usual ranges of the method
LEAST_SPREAD = 0.3  # of a trial's score, where a few agree by chance


@dataclass(frozen=True)
class Plan:
    """Arguments of a challenge, and the values that follow from them before the first trial.

    Raises
    ------
    InputError
        A number out of its range.
    """

    minutes: float | None = 5.0  # None: ``trials`` count instead
    trials: int | None = None  # of the search, at most
    seed: int = 0
    jobs: int = -1
    false_alarm: float = FALSE_ALARM  # probability that a challenge finds a right filter overconfident
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
    def seeds(self) -> tuple[int, int]:
        """Seeds of the search and of the confirmation, which share no trial."""
        search_, confirm_ = np.random.SeedSequence(self.seed).generate_state(2)
        return int(search_), int(confirm_)


@dataclass(frozen=True)
class Challenge:
    """Result of a challenge."""

    filter: str
    plan: Plan
    space: Space
    point: Point  # the most overconfident world of the search
    ratio: float  # true over stated covariance there, in a typical run of the search
    world: Scenario  # the scenario of that point
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
) -> Challenge:
    """Look for the world in which a filter is most overconfident, and confirm it on fresh trials.

    Exactly one confirmation is made, of a number of runs that is fixed beforehand, with seeds that the search has not
    used. So a filter that is right in every world is found overconfident with probability ``plan.false_alarm`` or less,
    however long the search was. What is found depends on the seed and, unless ``plan.trials`` is given, on the time.

    Parameters
    ----------
    base : the scenario whose values are the plain ones; None for the first of :data:`BASES` that fits the filter
    within : bounds of dimensions, see ``consistency.bench.challenging.world_space.space_of``

    Raises
    ------
    InputError
        Unknown filter or scenario, one that does not fit the other, or bounds that hold no world.
    """
    plan = Plan() if plan is None else plan
    instance, scenario = opponents(filter_, base)
    space = space_of(scenario, within)
    with ChallengeScorer(instance, plan.jobs) as bench:
        bench.compile(corners(space))
        return ChallengePhases(bench, space, plan).run()


def opponents(filter_: str | Filter, base: str | Scenario | None) -> tuple[Filter, Scenario]:
    """The filter, and the scenario from which its worlds differ; raises InputError."""
    instance = get_filter(filter_) if isinstance(filter_, str) else filter_
    scenario = load_scenario(base) if isinstance(base, str) else base
    if scenario is None:
        scenario = base_of(instance)
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
    few, many = list(space.plain), list(space.plain)
    for i, dimension in enumerate(space.dimensions):
        if dimension.name == "density":
            few[i] = dimension.at(0.0)
        if dimension.name in ("density", "range"):
            many[i] = dimension.at(1.0)
    worlds = [scenario_of(space, point) for point in (space.plain, tuple(few), tuple(many))]
    return [world for world in worlds if world is not None]


def scenario_of(space: Space, point: Point) -> Scenario | None:
    """The world of a point; None where there is none."""
    try:
        return space.world(point)
    except ValueError:
        return None


class ChallengePhases:
    """One challenge: the counts, and the phases in order."""

    def __init__(self, bench: ChallengeScorer, space: Space, plan: Plan) -> None:
        self.bench, self.space, self.plan = bench, space, plan
        self.search_seed, self.confirm_seed = plan.seeds
        self.budget = Budget(None if plan.minutes is None else 60.0 * plan.minutes, plan.trials)
        seconds = self.budget.seconds
        self.slowest = np.inf if seconds is None else CONFIRM * seconds * bench.workers / plan.runs  # for one trial
        self.tried: dict[Point, ScoredWorld] = {}
        self.told = time.monotonic()

    def run(self) -> Challenge:
        """Search for the worst world and confirm it on fresh trials."""
        name, plan = name_of(self.bench.filter), self.plan
        worst = self.search()
        self.tell(f"confirming on {plan.runs} fresh runs", now=True)
        world = self.space.world(worst.point, f"challenge-{name}")
        results = run_trials(world, [self.bench.filter], plan.runs, self.confirm_seed, plan.jobs)
        verdict = analyse(results, settings=Settings(plan.false_alarm))[name]
        unusable = sum(not candidate.usable for candidate in self.tried.values())
        return Challenge(
            filter=name,
            plan=plan,
            space=self.space,
            point=worst.point,
            ratio=float(np.exp(np.mean(worst.scores))),
            world=world,
            verdict=verdict,
            worlds=len(self.tried) - unusable,
            trials=self.budget.used,
            unusable=unusable,
            seconds=self.budget.elapsed,
        )

    def search(self) -> ScoredWorld:
        """Return the most overconfident candidate."""
        rng = np.random.default_rng(self.search_seed)
        search(self.space, self.evaluate, partial(self.budget.left, SEARCH), rng, self.tried)
        usable = ranked(self.tried.values())
        if not usable:
            raise InputError(
                f"scenario '{self.space.base.name}': no world within the bounds can be tried in this time; widen "
                "--within, give more --minutes or another --scenario"
            )
        return usable[0]

    def evaluate(self, candidates: Sequence[ScoredWorld], trials: int) -> None:
        """Give candidates trials up to this number in all."""
        ready = []
        for candidate in candidates:
            world = scenario_of(self.space, candidate.point)
            candidate.usable = world is not None
            if world is not None:
                ready.append((candidate, (world, range(len(candidate.scores), trials))))
        done = self.bench([job for _, job in ready], self.search_seed, self.budget.until(SEARCH))
        for (candidate, _), scored in zip(ready, done, strict=True):
            candidate.usable = scored is not None and scored.seconds <= self.slowest
            if scored is not None:
                candidate.scores += scored.scores
                self.budget.used += len(scored.scores)
        self.tell("searching")

    def tell(self, what: str, now: bool = False) -> None:
        """Print a line of progress, every few seconds."""
        if now or time.monotonic() - self.told >= EVERY:
            self.told = time.monotonic()
            worlds, trials = len(self.tried), self.budget.used
            line = f"{what}: {self.budget.elapsed:.0f} s, {worlds} worlds, {trials} trials"
            print(line, file=sys.stderr, flush=True)


def challenge_lines(outcome: Challenge, out: Path) -> list[str]:
    """What to print; ``out`` is the file that was written, if the filter was found overconfident."""
    plan, verdict = outcome.plan, outcome.verdict
    name = outcome.filter
    duration = f"{outcome.seconds / 60:.1f} minutes" if outcome.seconds >= 90 else f"{outcome.seconds:.0f} s"
    searched = f"{outcome.worlds} worlds and {outcome.trials} trials in {duration}"
    tested = f"ANEES {verdict.statistic:.3g} (3 is right), {verdict.status}, on {verdict.runs} fresh runs"
    if verdict.failures:
        tested += f", of which {len(verdict.failures)} broke down"
    world = f"{outcome.space.text(outcome.point)}: ratio {outcome.ratio:.3g} in a typical run of the search"
    if not outcome.found:
        budget_text = f"{plan.minutes:g} minutes" if plan.minutes is not None else f"{plan.trials} trials"
        return [
            f"{name}: no world found within {budget_text} in which it is overconfident",
            f"  most overconfident: {world}",
            f"  that world: {tested}",
            f"  searched: {searched}; no proof that there is no such world",
        ]
    p = f", p {p_text(outcome.p_value)}" if np.isfinite(outcome.p_value) else ""
    rate = f"a right filter is found so in at most {plan.false_alarm:.3g} of challenges"
    return [
        f"{name} is overconfident in {world}",
        f"  confirmed: {tested}{p}; {rate}",
        f"  searched: {searched}",
        f"  {out} has the world; again: {command(outcome, out)}",
    ]


def command(outcome: Challenge, out: Path) -> str:
    """The command that repeats the confirmation."""
    seed = outcome.plan.seeds[-1]
    return f"consistency run {out} --filter {outcome.filter} --runs {outcome.plan.runs} --seed {seed} --out results"


def challenge_data(outcome: Challenge, out: Path) -> dict[str, Any]:
    plan, verdict, space = outcome.plan, outcome.verdict, outcome.space
    search_seed, confirm_seed = plan.seeds
    return {
        "filter": outcome.filter,
        "base": space.base.name,
        "found": outcome.found,
        "world": space.values(outcome.point),
        "plain": space.values(space.plain),
        "scenario_hash": outcome.world.hash,
        "status": verdict.status,
        "anees": plain(verdict.statistic),
        "p_value": plain(outcome.p_value),
        "runs": verdict.runs,
        "failures": len(verdict.failures),
        "false_alarm": plan.false_alarm,
        "detect": plan.detect,
        "ratio": outcome.ratio,
        "worlds": outcome.worlds,
        "unusable": outcome.unusable,
        "trials": outcome.trials,
        "seconds": outcome.seconds,
        "seed": plan.seed,
        "seeds": {"search": search_seed, "confirmation": confirm_seed},
        "file": str(out) if outcome.found else None,
    }


def require_scenario_file(out: Path, overwrite: bool) -> None:
    """Refuse a file that cannot be written, before the search.

    Raises
    ------
    InputError
        Another ending than .toml, a file that is there already, or no folder to put it in.
    """
    if out.suffix != ".toml":
        raise InputError(f"--out {out}: must end in .toml")
    if out.is_dir() or (out.exists() and not overwrite):
        raise InputError(f"--out {out}: exists already; name another file or add --overwrite")
    if not out.parent.is_dir():
        raise InputError(f"--out {out}: there is no folder {out.parent}; make it first")


def write_scenario(outcome: Challenge, out: Path) -> None:
    """Write the world of a filter that was found overconfident, whole or not at all."""
    verdict = outcome.verdict
    summary = (
        f"{outcome.filter} is {verdict.status} here, ANEES {verdict.statistic:.3g} in {verdict.runs} runs: "
        f"{outcome.space.text(outcome.point)}"
    )
    text = scenario_text(
        outcome.world.variant(out.stem, summary=summary), f"Found by a challenge; again: {command(outcome, out)}"
    )
    with writing(out):
        write_whole(out, text.encode("utf-8"))


@dataclass(frozen=True)
class Done:
    """Scores of the trials of a world, fewer than were asked for where the time was up."""

    scores: tuple[float, ...]
    seconds: float  # of the fastest trial; others may have waited for a busy machine


class ChallengeScorer:
    """Scores one filter; to be used in a ``with``, which holds the workers.

    The score of a trial is log(mean NEES of the run / 3), which is 0 or a little less for a right filter. The
    logarithm keeps one diverged run among many from deciding which of two worlds is worse.
    """

    def __init__(self, filter_: Filter, jobs: int = -1) -> None:
        self.filter, self.workers = filter_, worker_count(jobs)
        # kernels release the GIL; other filters run in processes, for which threads wait
        self._pool = ThreadPoolExecutor(self.workers)

    def __enter__(self) -> ChallengeScorer:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def compile(self, worlds: Sequence[Scenario]) -> None:
        """Compile what the filter needs in these worlds, so that a search spends no time on it."""
        compile_all(first_trials((self.filter, world) for world in worlds), self.workers)

    def __call__(self, jobs: Sequence[Job], seed: int, until: float = np.inf) -> list[Done | None]:
        """Scores of each job in its order; None for a world in which no landmark comes into view.

        No trial begins after ``until``, a time of ``time.monotonic``.
        """
        with one_blas_thread():
            return list(self._pool.map(lambda job: _score(self.filter, job, seed, until), jobs))


def _score(filter_: Filter, job: Job, seed: int, until: float) -> Done | None:
    scenario, runs = job
    if time.monotonic() >= until:
        return Done((), 0.0)
    try:
        world = require_landmarks_in_view(scenario)
    except InputError:
        return None
    scores, fastest = [], np.inf
    timeout = until - time.monotonic() + PATIENCE if np.isfinite(until) else None
    with Isolation([filter_], scenario.belief, timeout) as isolation:
        for run in runs:
            began = time.monotonic()
            if began >= until:
                break
            scores.append(score_of_run(isolation, world, run, seed))
            fastest = min(fastest, time.monotonic() - began)
    return Done(tuple(scores), fastest if scores else 0.0)


def score_of_run(isolation: Isolation, world: World, run: int, seed: int) -> float:
    """log(mean NEES / 3) of a run of the one filter, in its own error; :data:`WORST` where it failed."""
    trial = world.trial(run, seed)
    outcome = outcome_of(trial, isolation.run(trial))
    if outcome.failures:
        return WORST
    [columns] = outcome.estimates.values()
    nees = np.asarray(columns.get("own_nees", columns["nees"]), float)
    nees = nees[np.isfinite(nees)]
    if not len(nees):
        return WORST
    with np.errstate(divide="ignore"):
        return float(np.clip(np.log(nees.mean() / len(POSE)), -WORST, WORST))


@dataclass
class ScoredWorld:
    """A point with the scores of its trials so far."""

    point: Point
    scores: list[float] = field(default_factory=list)
    usable: bool = True  # False where there is no such world, or it takes too long

    @property
    def score(self) -> float:
        if not self.scores or not self.usable:
            return -np.inf
        return float(np.mean(self.scores)) - standard_error(self.scores)


def standard_error(scores: Sequence[float]) -> float:
    """Of the mean of scores; a few that agree by chance are not taken at their word."""
    spread = float(np.std(scores, ddof=1)) if len(scores) > 1 else 0.0
    return max(spread, LEAST_SPREAD) / float(np.sqrt(len(scores)))


# gives each candidate scores up to a number of trials, as far as the budget goes, or marks it as not usable
Evaluate = Callable[[Sequence[ScoredWorld], int], None]


class Budget:
    """Time, or a number of trials, of which shares are spent; with trials the outcome does not depend on the clock."""

    def __init__(self, seconds: float | None = None, trials: int | None = None) -> None:
        self.seconds, self.trials = seconds, trials
        self.started, self.used = time.monotonic(), 0

    @property
    def elapsed(self) -> float:
        return time.monotonic() - self.started

    def left(self, share: float) -> bool:
        """Is less than this share of the budget spent?"""
        if self.trials is not None:
            return self.used < share * self.trials
        return self.seconds is None or self.elapsed < share * self.seconds

    def until(self, share: float) -> float:
        """The time of ``time.monotonic`` at which this share is spent; infinite with a number of trials."""
        return np.inf if self.seconds is None else self.started + share * self.seconds


def search(
    space: Space,
    evaluate: Evaluate,
    left: Callable[[], bool],
    rng: np.random.Generator,
    tried: dict[Point, ScoredWorld],
) -> None:
    """Try batches of points, which are added to those ``tried`` before.

    Parameters
    ----------
    evaluate : gives candidates trials
    left : whether to continue with another batch, and another rung
    """
    even = qmc.Halton(len(space.dimensions), rng=rng)
    while left():
        batch = _batch(space, tried, even, rng)
        if not batch:
            break
        tried |= {candidate.point: candidate for candidate in batch}
        _race(batch, evaluate, left)
        if len(tried) >= HOPELESS and not any(candidate.usable for candidate in tried.values()):
            break


def ranked(candidates: Iterable[ScoredWorld]) -> list[ScoredWorld]:
    """Usable candidates, the worst first; those with the trials of the last rung before the others."""
    usable = [c for c in candidates if c.usable and c.scores]
    return sorted(usable, key=lambda c: (len(c.scores) >= RUNGS[-1], c.score), reverse=True)


def _race(batch: list[ScoredWorld], evaluate: Evaluate, left: Callable[[], bool]) -> None:
    alive = batch
    for trials in RUNGS:
        if not left():
            return
        evaluate(alive, trials)
        alive = sorted((c for c in alive if c.usable), key=lambda c: c.score, reverse=True)
        alive = alive[: max(1, len(alive) // 2)]


def _batch(
    space: Space, tried: dict[Point, ScoredWorld], even: qmc.Halton, rng: np.random.Generator
) -> list[ScoredWorld]:
    """New points; the first of all is that of the base."""
    elite = sorted((c for c in tried.values() if c.usable and c.scores), key=lambda c: c.score, reverse=True)[:ELITE]
    new_points: dict[Point, ScoredWorld] = {} if tried else {space.plain: ScoredWorld(space.plain)}
    for _ in range(20 * BATCH):  # a small space has no more to offer
        if len(new_points) == BATCH:
            break
        if len(elite) >= 4 and len(new_points) >= EVEN:
            place = _varied(np.array([space.where(each.point) for each in elite]), rng)
        else:
            place = even.random()[0]
        point = space.at(place)
        if point not in tried and point not in new_points:
            new_points[point] = ScoredWorld(point)
    return list(new_points.values())


def _varied(elite: Array, rng: np.random.Generator) -> Array:
    """A point of the elite (n, d) with some coordinates moved along the difference of two others."""
    base, plus, minus = rng.choice(len(elite), 3, replace=False)
    moved = elite[base] + STEP * (elite[plus] - elite[minus]) + JITTER * rng.standard_normal(elite.shape[1])
    is_mutated = rng.random(elite.shape[1]) < CROSSOVER
    is_mutated |= np.arange(elite.shape[1]) == rng.integers(elite.shape[1])
    u = np.where(is_mutated, moved, elite[base])
    return np.asarray(1.0 - np.abs(1.0 - np.abs(u) % 2.0))  # reflected at 0 and 1
