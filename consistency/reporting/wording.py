"""Numbers and records as words, the same in every format."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from consistency.reporting.model import STATUSES, Distribution, Study, Track

MEANING = {
    "consistent": "the errors are as large as the covariance says",
    "overconfident": "the errors are larger than the covariance says",
    "conservative": "the errors are smaller than the covariance says",
    "failed": "a run broke down, or there was nothing to judge",
}
VERDICT_COLUMNS = (
    "Filter",
    "Verdict",
    "Mean ANEES",
    "Share of steps in the pointwise band",
    "First step outside the simultaneous band",
    "2-sigma coverage x / y / heading (%)",
    "RMSE position (m)",
    "RMSE heading (deg)",
    "NIS / dof",
    "Failed runs",
)


LISTED = 6  # pairs of filter and scenario that the first paragraph names one by one


def number(value: Any, form: str) -> str:
    """A number, or a dash where there is none."""
    return "–" if value is None or not np.isfinite(value) else format(float(value), form)


def verdict_row(track: Track) -> tuple[str, ...]:
    """Cells of the verdict table, as VERDICT_COLUMNS."""
    s = track.verdict.statistics
    covered = s.get("coverage")
    heading = s.get("rmse_heading")
    first = s.get("first_outside")
    return (
        track.name,
        track.verdict.status,
        number(s.get("mean_anees"), ".0f" if s.get("mean_anees", 0) >= 100 else ".2f"),
        number(s.get("share_inside"), ".2f"),
        str(first) if first is not None else ("never" if s.get("judged_steps") else "–"),
        " / ".join(number(100 * c, ".1f") for c in covered) if covered and np.isfinite(covered).any() else "–",
        number(s.get("rmse_position"), ".3f"),
        number(None if heading is None else np.rad2deg(heading), ".2f"),
        number(s.get("nis_ratio"), ".3f"),
        f"{len(s['failures'])} of {s['runs']}",
    )


def answer(studies: Sequence[Study], findings: Sequence[dict[str, Any]]) -> str:
    """Who is honest and who is not, in one paragraph."""
    pairs = [(track, study) for study in studies for track in study.tracks]
    text = []
    if pairs:
        honest = sum(track.verdict.consistent for track, _ in pairs)
        passed = ("is" if honest == 1 else "are") + " honest about the uncertainty of the pose"
        if not any(study.has_truth for study in studies):
            passed = ("passes" if honest == 1 else "pass") + " the test of the innovations, the only one without truth"
        if len(studies) == 1:
            size = f"{_count(studies[0].runs, 'run')} of {_count(len(studies[0].steps), 'step')}"
            text.append(f"In {studies[0].name} ({size}), {honest} of {_count(len(pairs), 'filter')} {passed}.")
        else:
            text.append(
                f"{len(studies)} studies put {len(pairs)} pairs of filter and scenario to the test; {honest} {passed}."
            )
        text += [sentence for status in STATUSES if (sentence := _status_sentence(status, pairs, len(studies)))]
        text.append(_failure_sentence(studies))
    if any(not study.has_truth for study in studies):
        text.append("Where the truth is not known the innovations alone decide, and they cannot see most pose errors.")
    if findings:
        text.insert(0, _finding_sentence(findings))
    return " ".join(text) or "This folder holds neither results nor findings."


def _status_sentence(status: str, pairs: list[tuple[Track, Study]], studies: int) -> str:
    by_study: dict[str, list[str]] = {}
    for track, study in pairs:
        if track.verdict.status == status:
            by_study.setdefault(study.name, []).append(track.name)
    if not by_study:
        return ""
    count = sum(map(len, by_study.values()))
    if count > LISTED:
        return f"{count} are {status} ({MEANING[status]})."
    where = [listed(names) + (f" in {study}" if studies > 1 else "") for study, names in by_study.items()]
    return f"{status.capitalize()} ({MEANING[status]}): {'; '.join(where)}."


def _failure_sentence(studies: Sequence[Study]) -> str:
    failed = sum(len(study.failures) for study in studies)
    total = sum(study.runs * len(study.tracks) for study in studies)
    if not failed:
        return "No run broke down."
    return f"{failed} of {total} runs through a filter broke down; they are listed below and counted in the verdicts."


def _finding_sentence(findings: Sequence[dict[str, Any]]) -> str:
    verdicts = [str(finding["verdict"]) for finding in findings]
    counts = [f"{verdicts.count(verdict)} {verdict}" for verdict in dict.fromkeys(verdicts)]
    return f"Of {_count(len(findings), 'finding')}, {listed(counts)}."


def listed(words: Sequence[str]) -> str:
    """a, b and c."""
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)


def _count(value: int, noun: str) -> str:
    return f"{value} {noun}{'s' * (value != 1)}"


def no_truth(study: Study) -> str:
    """Why there are no error plots."""
    return (
        f"The truth of {study.name} is not known, so there are no pose errors and no NEES to show; "
        "the innovations below are what the filter can be judged by."
    )


def scenario_caption(study: Study) -> str:
    """What the map shows."""
    parts = []
    if study.true_path is not None:
        parts.append("true path solid black with its start as a circle")
    if study.odometry is not None:
        parts.append("path by odometry alone dashed grey")
    if study.landmarks is not None:
        parts.append(f"{len(study.landmarks)} landmarks as stars")
    parts.append("estimates in the filters' colours")
    note = "" if study.odometry is not None else " The odometry path is left out: results of a log hold no controls."
    return f"{study.name} from above, run {study.shown_run}: {', '.join(parts)}.{note}"


def error_caption(study: Study) -> str:
    """What the error charts show."""
    return (
        f"Pose error (truth minus estimate) of run {study.shown_run}, the lowest run number, with the filter's own "
        "2-sigma bounds (dashed). An honest filter's error stays inside about 95 % of the time."
    )


def anees_caption(study: Study) -> str:
    """What the ANEES chart shows."""
    what = f"NEES of the single run {study.shown_run}" if study.single else f"Average NEES over {study.runs} runs"
    common = study.common_band
    n = common.verdict.statistics["dof"] if common else 3
    own = [track.name for track in study.tracks if track.own_band]
    extra = (
        f" Fewer runs carry the curve of {listed(own)}; its wider bands are thin lines in its colour." if own else ""
    )
    return (
        f"{what}; {n} is expected (line). Shaded: the 95 % band of a single step (eq. 17). Dashed: the band that "
        f"a consistent filter leaves anywhere in the run with probability at most 5 %. Above is overconfident, below "
        f"conservative.{extra}"
    )


def nis_caption(study: Study) -> str:
    """What the NIS chart shows."""
    return (
        "Normalized innovation squared over its degrees of freedom, one point a step"
        + ("" if study.single else f", summed over {study.runs} runs")
        + "; not smoothed. 1 is expected (line)."
    )


def distribution_caption(d: Distribution) -> str:
    """What one panel pair of fig. 12 shows, with its numbers."""
    linear, fitted = (float(np.sqrt(g.covariance[0, 0])) for g in (d.linear, d.fitted))
    beyond = f" {100 * d.outside:.1f} % of the samples lie beyond the axes." if d.outside >= 0.0005 else ""
    return (
        f"Baseline {d.baseline:g} m: {d.samples} samples of eq. 21 within the search range, for a point at x = 10 m, "
        f"y = 1 m ({len(d.points)} drawn). Standard deviation of x: {linear:.2f} m linearised, {fitted:.2f} m from the "
        f"samples' moments; mean {d.fitted.mean[0]:.2f} m.{beyond} Ellipses at 2 sigma."
    )
