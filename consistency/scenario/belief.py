"""What the filter takes to be the case."""

from __future__ import annotations

from consistency.scenario.sensor import BelievedSensor
from consistency.scenario.tables import Finite, NonNegative, Positive, Table


class BelievedMotion(Table):
    sigma_v: NonNegative
    sigma_omega: NonNegative


class SigmaPoints(Table):
    """Scaled sigma points over the L variables that a transform involves (robot, or robot and seen).

    Spread alpha sqrt(L + kappa), weights after Merwe (2004). The default (1, 0, 0) is the cubature set of
    Arasaratnam & Haykin (2009): spread sqrt(L), no centre point, no weight negative, so that S stays
    positive definite however many landmarks are seen; it has no parameter to tune.
    """

    alpha: Positive = 1.0
    beta: NonNegative = 0.0
    kappa: Finite = 0.0


class Belief(Table):
    """What the filter takes to be the case."""

    motion: BelievedMotion
    sensor: BelievedSensor
    sigma_points: SigmaPoints = SigmaPoints()
