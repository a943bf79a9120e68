"""Looking at the runs while they come, with error rates that hold for all looks together."""

from __future__ import annotations

from dataclasses import dataclass, replace

from consistency.diagnostics.planning import gate_runs
from consistency.types import Verdict

FIRST = 12  # runs at the first look at least; with fewer hardly anything but a failed run would be found


@dataclass(frozen=True)
class Design:
    """A group-sequential plan: when to look, and what each look may cost."""

    dof: int
    detect: float  # covariance ratio that must be found
    false_alarm: float  # of all looks together
    power: float
    looks: tuple[int, ...]  # runs at each look
    needed: int  # runs at which no fault found means consistent
    look_false_alarm: float  # of one look: an equal part for each planned look

    def settle(self, verdict: Verdict) -> Verdict:
        """The verdict at a look: where no fault is found before ``needed`` runs it is undecided."""
        runs = int(verdict.statistics["runs"])
        if verdict.status != "consistent" or runs >= self.needed:
            return verdict
        text = (
            f"undecided: no fault found in {runs} runs; {self.needed} are needed to find a covariance wrong by "
            f"x{self.detect:g} with power {self.power:g}"
        )
        return replace(verdict, status="undecided", reasons=(text, *verdict.reasons[1:]))


def sequential_design(
    dof: int, detect: float = 1.5, false_alarm: float = 0.05, power: float = 0.95, max_runs: int | None = None
) -> Design:
    """Looks at doubling numbers of runs, the last at what :func:`gate_runs` plans.

    Each of the L looks is the same verdict as ever at a false-alarm rate of ``false_alarm`` / L, so that the
    chance of a false alarm at any of them is at most ``false_alarm`` under any dependence between looks (Bonferroni;
    the constant spending of Pocock 1977 and Lan & DeMets 1983 without its assumption on increments). A fault stops
    at the first look that finds it; that none is there takes the last look, where the power is the stated
    one. Looks beyond ``max_runs`` are replaced by one at ``max_runs``; what is open then is undecided.

    Raises
    ------
    ValueError
        As :func:`required_runs`; ``max_runs`` below 1.
    """
    if max_runs is not None and max_runs < 1:
        raise ValueError(f"max_runs must be at least 1, got {max_runs}")
    count, needed = planned_looks(dof, detect, false_alarm, power)
    looks = [-(-needed // 2**k) for k in reversed(range(count))]
    if max_runs is not None and max_runs < needed:
        looks = [*(n for n in looks if n < max_runs), max_runs]
    return Design(dof, detect, false_alarm, power, tuple(looks), needed, false_alarm / count)


def planned_looks(dof: int, detect: float, false_alarm: float, power: float) -> tuple[int, int]:
    """Number of looks and runs at the last: the most looks whose first one has enough runs."""
    count, needed = 1, gate_runs(dof, detect, false_alarm, power)
    while True:
        more = gate_runs(dof, detect, false_alarm / (count + 1), power)
        if more < FIRST * 2**count:
            return count, needed
        count, needed = count + 1, more
