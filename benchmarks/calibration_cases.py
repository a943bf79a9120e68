"""What ``make calibrate`` measures: which promise in which world, with how many runs and gates."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from calibration_gates import DOF, STEPS
from calibration_worlds import HEAVY, LOGS, WORLDS

from consistency.diagnostics import gate_runs

FALSE_ALARM, POWER, DETECT = 0.05, 0.95, 1.5
QUICK_FAILURE = 2e-4  # probability that the quick rows of a referee that keeps its promises fail
MANY, SHOWING = 100, 50  # runs
MOST = 500  # runs of --until-decided
HEADLINE = 0.85  # of the planned runs, least share of verdicts named after the scale
LOG_STEPS = 1000
# ratio -> world -> runs with which the ratio is found with power 0.95
FOUND_BY = {
    1.2: {"AR(.95)": 70, "AR(.99)": 205, "linear-gaussian": 155},
    1.5: {"AR(.99)": 45, "linear-gaussian": 35},
    0.67: {"AR(.95)": 32},
}
BET_BY = {"AR(.95)": 75, "AR(.99)": 230, "fully dependent": 380}  # runs with which the e-process finds x1.2
# of right filters; those below 0.95 are what is reached, since a wrong all-clear is refused where runs differ
SHOWN = {"AR(.95)": 0.95, "AR(.99)": 0.93, "linear-gaussian": 0.9, "fully dependent": 0.82}


@dataclass(frozen=True)
class Claim:
    """A promise about a share of gates."""

    question: str
    counted: str  # which gates: a key of calibration.COUNTED
    stated: float
    bound: str  # "<=" or ">="


@dataclass(frozen=True)
class Case:
    """Gates of one world, judged in one way."""

    world: str
    runs: int  # of a gate; at most, of --until-decided
    gates: int
    claims: tuple[Claim, ...]
    ratio: float = 1.0  # of true to stated covariance
    false_alarm: float = FALSE_ALARM
    mode: str = "gate"  # or "until decided", "e-process"
    steps: int = STEPS


def cases() -> list[Case]:
    return [
        *(case for runs, rate, gates in alarm_plans() for case in _alarms(WORLDS, runs, rate, gates)),
        *_until_decided(WORLDS, 1000),
        *_bets(WORLDS, 1000),
        *_all_clears(WORLDS, 1000),
        *_planned_power((1.2, 1.5, 2.0, 0.67), 1000),
        *_found_by(FOUND_BY, 1000),
        *(
            Case(world, runs, 1000, (Claim("e-process, power", "overconfident", POWER, ">="),), 1.2, mode="e-process")
            for world, runs in BET_BY.items()
        ),
        *_decisions(("AR(.95)", "AR(.99)", "linear-gaussian", "fully dependent", "body frame"), 400),
        *_one_log(1000),
        *_words(HEAVY, (21, 61), (100, 301), 500),
    ]


def quick_cases() -> list[Case]:
    """What two or three minutes can measure: whether a promise is broken badly."""
    slow = ("AR(.95)", "AR(.99)", "fully dependent", "fully dependent, n = 1", "body frame", "5 % slow, n = 1")
    return [
        *_alarms(WORLDS, gate_runs(DOF, 2.0, FALSE_ALARM, POWER), FALSE_ALARM, 150),
        *_alarms(WORLDS, MANY, FALSE_ALARM, 80),
        *_until_decided(("AR(.95)", "fully dependent", "body frame", "Schmidt-Kalman"), 50),
        *_bets(slow, 100),
        *_all_clears(slow, 100),
        *_planned_power((2.0, 0.67), 100),
        *_found_by({1.2: {"AR(.95)": 70}, 1.5: {"AR(.99)": 45}}, 100),
        *_one_log(100),
        *_words(("t5", "Laplace"), (21,), (100,), 100),
    ]  # fmt: skip


def alarm_plans() -> list[tuple[int, float, int]]:
    """Runs, false-alarm rate and gates of the rows of right filters.

    The runs planned for a ratio of 2 are few, and hard to keep a rate with; what is estimated wrongly shows with many.
    """
    few, fewer = (gate_runs(DOF, 2.0, rate, POWER) for rate in (0.05, 0.01))
    return [(few, 0.05, 1000), (fewer, 0.01, 2000), (MANY, 0.05, 1000)]


def quick_confidence(rows: int) -> float:
    """Confidence of each row, with which all of them fail together by chance as seldom as is stated."""
    return 1.0 - QUICK_FAILURE / rows


def _alarms(worlds: Iterable[str], runs: int, rate: float, gates: int) -> list[Case]:
    claim = Claim("false alarm", "fault", rate, "<=")
    return [Case(world, runs, gates, (claim,), false_alarm=rate) for world in worlds]


def _until_decided(worlds: Iterable[str], gates: int) -> list[Case]:
    claim = Claim("until decided, false alarm", "fault", FALSE_ALARM, "<=")
    return [Case(world, MOST, gates, (claim,), mode="until decided") for world in worlds]


def _decisions(worlds: Iterable[str], gates: int) -> list[Case]:
    claims = (
        Claim("until decided, power", "fault", POWER - 0.02, ">="),  # approximately what is not called consistent
        Claim("until decided, wrong all-clear", "consistent", 1.0 - POWER, "<="),
    )
    return [Case(world, MOST, gates, claims, DETECT, mode="until decided") for world in worlds]


def _bets(worlds: Iterable[str], gates: int) -> list[Case]:
    claim, runs = Claim("e-process, false alarm", "fault", FALSE_ALARM, "<="), gate_runs(DOF, 1.2, FALSE_ALARM, POWER)
    return [Case(world, runs, gates, (claim,), mode="e-process") for world in worlds if WORLDS[world].dof]


def _all_clears(worlds: Iterable[str], gates: int) -> list[Case]:
    """Ratios at either end of the interval, and right filters that should be shown to lie inside."""
    wrong = Claim("wrong all-clear", "consistent", 1.0 - POWER, "<=")
    there = [world for world in worlds if WORLDS[world].dof]
    return [
        *(Case(world, SHOWING, gates, (wrong,), ratio) for ratio in (DETECT, 1.0 / DETECT) for world in there),
        *(
            Case(world, SHOWING, gates, (Claim("all-clear", "consistent", SHOWN[world], ">="),))
            for world in there if world in SHOWN
        ),
    ]  # fmt: skip


def _planned_power(ratios: Iterable[float], gates: int) -> list[Case]:
    """The plan counts on the worst case, and approximates a verdict by its main question: 2 points less are allowed.

    A few runs cannot always tell a wrong scale from heavy tails, so that some headlines name the tails.
    """
    found = Claim("power", "wrong scale", POWER - 0.02, ">=")
    return [
        Case(
            "fully dependent", gate_runs(DOF, r, FALSE_ALARM, POWER), gates, (found, _power(r, HEADLINE, "headline")), r
        )
        for r in ratios
    ]


def _found_by(runs: dict[float, dict[str, int]], gates: int) -> list[Case]:
    return [Case(world, n, gates, (_power(r, POWER),), r) for r, of in runs.items() for world, n in of.items()]


def _power(ratio: float, stated: float, question: str = "power") -> Claim:
    return Claim(question, "overconfident" if ratio > 1.0 else "conservative", stated, ">=")


def _one_log(gates: int) -> list[Case]:
    (log,) = LOGS
    right = (Claim("false alarm", "fault", FALSE_ALARM, "<="), Claim("one log, all-clear", "consistent", 0.0, "<="))
    return [
        Case(log, 1, gates, right, steps=LOG_STEPS),
        Case(log, 1, gates, (_power(4.0, 0.85),), 4.0, steps=LOG_STEPS),
    ]


def _words(heavy: Iterable[str], runs: Sequence[int], uniform_runs: Sequence[int], gates: int) -> list[Case]:
    headline, where = Claim("heavy tails", "scale", 0.05, "<="), Claim("where", "located", 0.05, "<=")
    return [
        *(Case(world, n, gates, (headline,)) for world in heavy for n in runs),
        *(Case("AR(.95)", n, gates, (where,), 1.2) for n in uniform_runs),
    ]
