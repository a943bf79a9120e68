"""What the filter takes to be the case."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from consistency.bench.scenario.sensor import BelievedSensor
from consistency.bench.scenario.toml_tables import Count, Finite, NonNegative, Positive, Table

Share = Annotated[float, Field(gt=0, lt=1, strict=True)]


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


class GuardSettings(Table):
    """What a guarded filter takes for spurious; an unguarded one does not read it.

    ``confidence`` is the share of right observations that a gate lets pass. The default, 0.99, is that of Neira &
    Tardos (2001) and of Civera et al. (2010). ``threshold``, of ``ransac`` alone, is the distance in standard
    deviations up to which what is left of an innovation supports a hypothesis: 2, as in Civera et al. (2010).
    ``min_age`` is the number of sightings from which a track is used: with 1, the default, from the first on.
    ``forget_after`` is the number of observations of a landmark that are rejected one after the other until all later
    ones are refused; by default a landmark is never given up.
    """

    confidence: Share = 0.99
    threshold: Positive = 2.0
    min_age: Count = 1
    forget_after: Count | None = None


class Belief(Table):
    """What the filter takes to be the case."""

    motion: BelievedMotion
    sensor: BelievedSensor
    sigma_points: SigmaPoints = SigmaPoints()
    guard: GuardSettings | None = None  # None: the defaults

    @model_serializer(mode="wrap")
    def _without_guard(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A belief without the table has the content, and so the hash, of one that knows of no guards."""
        content: dict[str, Any] = handler(self)
        if self.guard is None:
            content.pop("guard", None)
        return content
