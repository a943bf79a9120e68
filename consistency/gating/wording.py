"""What a gate says when it does not pass."""

from __future__ import annotations

from collections.abc import Sequence


def fault_text(gate: str, name: str, reasons: Sequence[str]) -> str:
    """Gate, sentence, and what stands behind it."""
    first, *rest = reasons
    return "\n  - ".join([f"{gate}: {name} is {first}", *rest])


def plan_command(dof: int, detect: float, false_alarm: float, power: float, allow: str | None) -> str:
    """The command that plans the same number of runs."""
    return (
        f"consistency plan --dof {dof} --detect {detect!r} --false-alarm {false_alarm!r} --power {power!r}"
        + (f" --allow {allow}" if allow else "")
    )  # fmt: skip


def few_text(
    gate: str, name: str, runs: int, needed: int, detect: float, false_alarm: float, power: float, command: str | None
) -> str:
    """How many runs are missing, for what, and where the number comes from."""
    found, fault = "has no fault found", "a covariance wrong by"
    if command is None:
        found, fault = "is not found worse", "a covariance ratio farther from 1 by"
    text = (
        f"{gate}: {name} {found}, but {runs} run{'s are' if runs != 1 else ' is'} too few to pass: "
        f"{needed} find {fault} x{detect:g} with power {power:g} "
        f"at a false-alarm rate of {false_alarm:.3g}"
    )
    if command is None:  # of a comparison: the spread between the runs decides, not a table
        return f"{text}, at the spread between these runs. Simulate more runs, or ask for a larger detect."
    return f"{text}. Simulate {needed} runs, or ask for a larger detect; the same number: {command}"
