"""Plan of looks at growing numbers of runs, with error rates that hold at any stopping time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from consistency.referee.defaults import DETECT, FALSE_ALARM, POWER
from consistency.referee.diagnostics.verdict.answers import Settings

FIRST = 12  # runs at the first look; with fewer hardly anything but a failed run would be found
PARTS = 4  # times that the scale is looked at from one look to the next


@dataclass(frozen=True)
class Design:
    """Plan of looks, with the share of the false-alarm rate of each.

    The scale is tested by an e-process, which is valid at any time. All other questions are asked at looks after 12,
    24, 48, ... runs; look j = 0, 1, ... has the share 1 / ((j + 1) (j + 2)) of their false-alarm rate. The shares add
    to 1 at most, however many looks there are (Bonferroni).
    """

    dof: int
    detect: float = DETECT
    false_alarm: float = FALSE_ALARM  # of all looks together
    power: float = POWER
    max_runs: int | None = None  # what is open then is undecided
    lost: float | None = None  # see :class:`Settings`

    def __post_init__(self) -> None:
        if self.max_runs is not None and self.max_runs < 1:
            raise ValueError(f"max_runs must be at least 1, got {self.max_runs}")
        if self.dof < 1:
            raise ValueError(f"dof must be at least 1, got {self.dof}")
        _ = self.settings

    @property
    def settings(self) -> Settings:
        """Settings of each look."""
        return Settings(self.false_alarm, self.detect, self.power, lost=self.lost)

    def inspections(self) -> Iterator[tuple[int, float | None]]:
        """Numbers of runs at which to look, and the share of each look; None where only the scale is tested."""
        runs = FIRST
        j = 0
        last = self.max_runs
        while True:
            spent = 1.0 / ((j + 1) * (j + 2))
            if last is not None and runs >= last:
                yield last, spent
                return
            yield runs, spent
            for part in range(1, PARTS):
                between = runs + runs * part // PARTS
                if last is not None and between >= last:
                    break
                yield between, None
            runs = 2 * runs
            j = j + 1


def sequential_design(
    dof: int,
    detect: float = DETECT,
    false_alarm: float = FALSE_ALARM,
    power: float = POWER,
    max_runs: int | None = None,
    lost: float | None = None,
) -> Design:
    """A :class:`Design`.

    Raises
    ------
    ValueError
        A value out of its range.
    """
    return Design(dof, detect, false_alarm, power, max_runs, lost)
