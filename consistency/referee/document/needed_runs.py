"""Planned numbers of runs in words."""

from __future__ import annotations

from typing import Any

from consistency.referee.diagnostics.words.numbers import percent


def plan_lines(planned: dict[str, Any]) -> list[str]:
    """Runs that a verdict takes, a line for each thing to be shown.

    A pilot tells how much its runs spread, and not how skewed they are: its power is that of axes and runs alike.
    """
    p = planned
    side = "small" if p["detect"] > 1.0 else "large"
    factor = p["detect"] if p["detect"] > 1.0 else 1.0 / p["detect"]
    lines = [
        f"{p['runs']} runs: a verdict at false alarm {p['false_alarm']:g} then finds a covariance too {side} by "
        f"x{factor:.3g} with power {p['power']:g}"
    ]
    if "lost" in p:
        lines.append(f"{p['lost_runs']} runs, none of them lost, show that at most {percent(p['lost'])} of all are")
    if "groups" in p:
        lines.append(
            f"{p['group_runs']} runs, {p['runs_in_group']} in each of {p['groups']} groups, find that in one group by "
            f"itself (--by); {p['runs_in_group']} are enough where each run passes through all groups"
        )
    lines.append(
        f"{p['one_step']} runs would do for a single chi-square test of one step, at the same rates; "
        f"--until-decided asks everything after {', '.join(map(str, p['looks']))}, ... runs and stops when it is clear"
    )
    return lines + [
        f"{like['runs']} runs do where steps depend on each other as those of {name} in {like['pilot_runs']} pilot "
        f"runs: a run is worth {like['effective_dof']:.3g} degrees of freedom or more, {p['dof']} in the worst case; "
        f"where some axes or some runs alone are slow, it may take up to {p['runs']}"
        for name, like in p.get("like", {}).items()
    ]
