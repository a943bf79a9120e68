"""Messages of a gate that does not pass."""

from __future__ import annotations

from collections.abc import Sequence

from consistency.referee.gating.watch import Terms


def fault_text(gate: str, name: str, reasons: Sequence[str]) -> str:
    first, *rest = reasons
    return "\n  - ".join([f"{gate}: {name} is {first}", *rest])


def plan_command(dof: int, terms: Terms) -> str:
    return (
        f"consistency plan --dof {dof} --detect {terms.detect!r} --false-alarm {terms.false_alarm!r} "
        f"--power {terms.power!r}"
        + (f" --allow {terms.allow}" if terms.allow else "")
        + (f" --lost {terms.lost!r}" if terms.lost is not None else "")
    )


def undecided_text(gate: str, name: str, sentence: str, needed: int, dof: int, terms: Terms) -> str:
    """Neither a fault nor that there is none: how many runs to simulate, and where the number comes from."""
    larger = "a larger detect" if terms.lost is None else "a larger detect and a larger lost"
    return (
        f"{gate}: {name} is {sentence}. Simulate {needed} runs, or ask for {larger}; the number that is enough "
        f"however the steps depend on each other: {plan_command(dof, terms)}"
    )


def few_to_compare(gate: str, name: str, runs: int, needed: int, terms: Terms) -> str:
    """How many runs a comparison lacks, and for what."""
    return (
        f"{gate}: {name} is not found worse, but {runs} run{'s are' if runs != 1 else ' is'} too few to pass: "
        f"{needed} find a covariance ratio farther from 1 by x{terms.detect:g} with power {terms.power:g} "
        f"at a false-alarm rate of {terms.false_alarm:.3g}, at the spread between these runs. Simulate more "
        "runs, or ask for a larger detect."
    )
