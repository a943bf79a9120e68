"""From recordings of files to verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from consistency.referee.diagnostics import Evidence, Settings, Verdict, judge
from consistency.referee.diagnostics.questions import SHARES
from consistency.referee.diagnostics.wording import plain
from consistency.referee.errors import InputError

POSES = {"heading", "yaw", "pitch", "roll"}  # what a pose has beside its position


def analyse_recordings(
    recordings: Sequence[Evidence],
    filters: Sequence[str] | None = None,
    settings: Settings | None = None,
    optimal_gain: bool = False,
) -> dict[str, Verdict]:
    """A verdict for every recording, or for those named; raises :class:`InputError` of a name that is not there.

    Parameters
    ----------
    optimal_gain : the filters declare one, so that their innovations are judged
    """
    settings = settings or Settings()
    named = {recording.name: recording for recording in recordings}
    verdicts = {}
    for name in filters or named:
        if name not in named:
            raise InputError(f"--filter {name}: is not in these files; there are: {', '.join(named)}")
        r = named[name]
        evidence = evidence_of_windows(r) if r.independent else replace(r, optimal_gain=optimal_gain)
        verdict = _unshown(judge(evidence, settings), r.unshown)
        first, *rest = verdict.reasons
        verdicts[name] = replace(
            verdict,
            reasons=(f"{first}; {r.caption}" if r.caption else first, *rest, *_other_ways(verdict, r)),
            convention=r.convention or None,
            align=r.align if r.convention else None,
            notes=tuple(r.notes),
            left_out_steps=tuple(r.left_out_steps),
        )
    return verdicts


def _unshown(verdict: Verdict, why: str) -> Verdict:
    """Undecided, for that reason; as it was without one, or where a window failed."""
    if not why or verdict.scale is None or verdict.status == "failed":
        return verdict
    scale = replace(verdict.scale, equivalence=replace(verdict.scale.equivalence, p_value=float("nan"), runs=None))
    ratio = f"the covariance ratio would be {plain(scale.inflation)} if they are, reported and not judged"
    reasons = (f"undecided: {why}; {ratio}", *verdict.reasons[1:])
    return replace(verdict, status="undecided", scale=scale, reasons=reasons)


def _other_ways(verdict: Verdict, r: Evidence) -> list[str]:
    """What else would decide on a single log of poses."""
    if (
        verdict.status != "undecided"
        or len(r.run_numbers) != 1
        or r.window is not None
        or not (r.convention and POSES & set(r.axes))
    ):
        return []
    return [
        "--relative 10s (or steps, or metres) makes many windows of one log, if the file has motions with covariances, "
        "or poses with cross-covariances (docs/files.md)"
    ]


def evidence_of_windows(r: Evidence) -> Evidence:
    """Independent windows as runs of a single step, numbered from 1; those without an error are none."""
    assert r.error is not None
    assert r.covariance is not None
    assert r.nees is not None
    runs, steps = r.error.shape[:2]
    there = np.isfinite(r.nees)
    number = np.arange(1, runs * steps + 1).reshape(runs, steps)
    failures = [(int(np.flatnonzero(r.run_numbers == f.run)[0]), f) for f in r.failures]
    for row, f in failures:
        there[row, f.step - 1] = True
    return Evidence(
        r.name, r.error[there][:, None], r.covariance[there][:, None], r.nees[there][:, None], r.dof,
        failures=tuple(replace(f, run=int(number[row, f.step - 1]), step=1) for row, f in failures), axes=r.axes,
        runs=number[there], unit="window", unavailable=tuple(SHARES) if r.unshown else (), skipped=r.skipped,
    )  # fmt: skip
