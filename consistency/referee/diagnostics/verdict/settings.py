"""The questions of a verdict, and its error rates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from consistency.referee.defaults import DETECT, FALSE_ALARM, POWER


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
    tolerance: float | None = None  # a ratio shown to lie in [1 / tolerance, tolerance] is no fault
    allow: str | None = None  # "conservative": a covariance that is too large is no fault
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
