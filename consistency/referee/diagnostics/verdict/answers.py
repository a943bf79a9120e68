"""The questions of a verdict: its settings, the share of the false-alarm rate of each, and Holm's correction."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from consistency.referee.defaults import DETECT, FALSE_ALARM, POWER
from consistency.referee.diagnostics.verdict.parts import Answer
from consistency.referee.types import Array

CERTAIN = 0.999  # false-alarm rate, at most
MAIN = "scale"
STEP = "scale in some step"
AXIS = "scale of an axis"
DIRECTION = "scale in some direction"
SCALE = (MAIN, STEP, AXIS, DIRECTION)
BIAS = ("bias", "bias in some step")
SHAPE = ("shape", "shape in some step")
INNOVATIONS = ("innovation scale", "innovation whiteness")
GROUP = "scale in some group"
JOINT = "scale of pose and map"
JOINT_DISTRIBUTION = "distribution of pose and map"
# Share of the false-alarm rate of each question; those that are asked share what the main one leaves. Half goes to
# the mean over the trajectory, so that the number of runs planned for a covariance ratio does not depend on what
# else is asked.
SHARES = {
    MAIN: 0.5,
    STEP: 0.1,
    AXIS: 0.1,
    DIRECTION: 0.1,
    GROUP: 0.2,
    "bias": 0.05,
    "bias in some step": 0.05,
    "shape": 0.05,
    "shape in some step": 0.05,
    "outliers": 0.025,
    "distribution": 0.025,
    "innovation scale": 0.025,
    "innovation whiteness": 0.025,
    JOINT: 0.1,
    JOINT_DISTRIBUTION: 0.025,
}
ABOUT = {
    MAIN: "mean NEES of whole trajectories against its degrees of freedom",
    STEP: "ANEES of every step against its simultaneous band",
    AXIS: "the same mean for each axis and subset by itself",
    DIRECTION: "largest eigenvalue of the mean whitened second moment, where only too small a covariance is a fault",
    GROUP: "mean NEES of each run over its steps in a group, for each group by itself",
    "bias": "Hotelling's T-squared of the mean whitened error of a trajectory",
    "bias in some step": "Hotelling's T-squared of every step",
    "shape": "mean products of different whitened components over a trajectory",
    "shape in some step": "Mauchly's sphericity of the whitened errors of every step",
    "outliers": "Wilks' largest distance of one run from the others in any step",
    "distribution": "Kolmogorov's distance of the NEES from chi-square, one step a run",
    "innovation scale": "total NIS against its degrees of freedom",
    "innovation whiteness": "portmanteau test of the autocorrelation over steps",
    JOINT: "NEES of pose and all landmarks together against its degrees of freedom",
    JOINT_DISTRIBUTION: "Kolmogorov's distance of that NEES from chi-square, one value a run",
}
# what is wrong, where the answer to one of these questions is the only fault
ALONE = {
    JOINT_DISTRIBUTION: "the NEES of pose and map together does not follow the chi-square distribution",
    "distribution": "the NEES does not follow the chi-square distribution",
}


@dataclass(frozen=True)
class Settings:
    """Questions of a verdict, and its error rates.

    Raises
    ------
    ValueError
        A value out of its range.
    """

    false_alarm: float = FALSE_ALARM  # chance to find a fault in a right filter, all questions together
    detect: float = DETECT  # consistent: the ratio of true to stated covariance is shown to be in [1 / detect, detect]
    power: float = POWER  # a filter at either end is not called consistent, with this probability or more
    tolerance: float | None = None  # a ratio shown to lie in [1 / tolerance, tolerance] is not a fault
    allow: str | None = None  # "conservative": a covariance that is too large is not a fault
    method: str = "max"  # of the band over all steps: "max" or "bonferroni"
    subsets: Mapping[str, Sequence[int]] | None = None  # further groups of components to look at, name -> indices
    lost: float | None = None  # consistent: the share of lost runs is shown to be this at most

    def __post_init__(self) -> None:
        for name in ("false_alarm", "power"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} must lie between 0 and 1, got {getattr(self, name)}")
        for name in ("detect", "tolerance"):
            value = getattr(self, name)
            if value is not None and not (0.0 < value < float("inf") and value != 1.0):
                raise ValueError(f"{name} must be a positive ratio of true to stated covariance, not 1; got {value}")
        if self.lost is not None and not 0.0 < self.lost < 1.0:
            raise ValueError(f"lost must lie between 0 and 1, got {self.lost}")
        if self.allow not in (None, "conservative"):
            raise ValueError(f"allow must be 'conservative' or None, got '{self.allow}'")
        if self.method not in ("max", "bonferroni"):
            raise ValueError(f"method must be 'max' or 'bonferroni', got '{self.method}'")

    @property
    def factor(self) -> float:
        """``detect`` as a factor above 1."""
        return max(self.detect, 1.0 / self.detect)

    @property
    def tolerated(self) -> float:
        """``tolerance`` as a factor of 1 or more; 1 where nothing is tolerated."""
        if self.tolerance is None:
            return 1.0
        return max(self.tolerance, 1.0 / self.tolerance)

    @property
    def one_sided(self) -> bool:
        """Only a covariance that is too small is a fault."""
        return self.allow == "conservative"


def answers(p_values: Mapping[str, float], false_alarm: float) -> dict[str, Answer]:
    """Answers corrected for the number of questions: weighted Holm (1979), valid under any dependence.

    The probability that a right filter is found at fault in any question is at most ``false_alarm``. The main question
    keeps its share; the shares of questions that cannot be asked (p is NaN) go to the other ones. The
    adjusted p value of a question is the false-alarm rate at which it would just be found.
    """
    asked = {question: p for question, p in p_values.items() if np.isfinite(p)}
    share = shares_of(asked)
    found: dict[str, Answer] = {}
    left = 1.0
    least = 0.0
    for question in sorted(asked, key=lambda q: asked[q] / share[q]):
        least = max(least, min(1.0, asked[question] * left / share[question]))
        found[question] = Answer(question, asked[question], share[question], least, least <= false_alarm)
        left -= share[question]
    return {question: found[question] for question in asked}


def named_p_values(p_values: Mapping[str, float], named: Mapping[str, float]) -> dict[str, float]:
    """p values with those that ``named`` has in the place of others, each only once some question finds a fault.

    The ``named`` ones are smaller and not valid by themselves. None of them becomes so small that a fault would be
    found, in all questions together, at a smaller rate than before (a gatekeeping procedure).
    """
    share = shares_of([question for question, p in p_values.items() if np.isfinite(p)])
    least = min((p_values[question] / share[question] for question in share), default=1.0)
    return dict(p_values) | {q: max(named[q], least * share[q]) for q in named if q in share}


def shares_of(questions: Collection[str]) -> dict[str, float]:
    """Share of the false-alarm rate of each of the ``questions`` that are asked together; they add to 1."""
    if set(questions) == {MAIN}:
        return {MAIN: 1.0}
    kept = 0.0
    if MAIN in questions:
        kept = SHARES[MAIN]
    total = sum(SHARES[q] for q in questions if q != MAIN)
    shares = {}
    for question in questions:
        if question == MAIN:
            shares[question] = kept
        else:
            shares[question] = SHARES[question] * (1.0 - kept) / total
    return shares


def at_share(given: Sequence[Answer], settings: Settings) -> Settings:
    """Settings at whose usual share the scale is asked as it was: at the whole rate where nothing else is asked."""
    share = SHARES[MAIN]
    for answer in given:
        if answer.question == MAIN:
            share = answer.share
    return replace(settings, false_alarm=min(settings.false_alarm * share / SHARES[MAIN], CERTAIN))


def faults_of(given: Sequence[Answer]) -> dict[str, Answer]:
    """Answers that found a fault, those within the tolerance left out, by question."""
    return {answer.question: answer for answer in given if answer.found and not answer.tolerated}


def with_tolerated(given: Sequence[Answer], questions: Collection[str]) -> tuple[Answer, ...]:
    """Answers with the faults in these questions marked as tolerated."""
    return tuple(replace(a, tolerated=a.tolerated or (a.found and a.question in questions)) for a in given)


def least_of_steps(p_values: Array) -> tuple[float, int | None]:
    """The smallest p value of all steps, corrected for their number, and its step 1..T."""
    count = int(np.isfinite(p_values).sum())
    if not count:
        return float("nan"), None
    return min(1.0, float(np.nanmin(p_values)) * count), int(np.nanargmin(p_values)) + 1
