"""Numbers and records as words, the same in every format."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from consistency.diagnostics.wording import short
from consistency.reporting.calibration import Calibration, Promise
from consistency.reporting.model import STATUSES, Study, Track

MEANING = {
    "consistent": "the errors are as large as the covariance says",
    "overconfident": "the errors are larger than the covariance says",
    "conservative": "the errors are smaller than the covariance says",
    "inconsistent": "the errors are otherwise than the covariance says, in more than their size",
    "undecided": "the runs do not suffice to say",
    "failed": "a run broke down, or there was nothing to judge",
}
VERDICT_COLUMNS = (
    "Filter",
    "Verdict",
    "Mean ANEES",
    "Covariance to multiply by",
    "Mainly",
    "Since step",
    "RMSE position (m)",
    "RMSE heading (deg)",
    "NIS / dof",
    "Failed runs",
)
FIGURE_COLUMNS = (
    "Filter",
    "Mean ANEES accepted",
    "Covariance ratio that would be found",
    "2-sigma coverage, all steps (%)",
    "Noncredibility (dB)",
    "Inclination (dB)",
    "NIS / dof, 95 % expected",
)
FOUND, NOT_FOUND, NOT_ASKED = "✗", "○", "–"
SMALLEST = 1e-6  # p value below which digits say nothing
LISTED = 6  # pairs of filter and scenario that the first paragraph names one by one


def number(value: Any, form: str) -> str:
    """A number, or a dash where there is none."""
    return "–" if value is None or not np.isfinite(value) else format(float(value), form)


def verdict_row(track: Track) -> tuple[str, ...]:
    """Cells of the verdict table, as VERDICT_COLUMNS."""
    s = track.verdict.statistics
    since, heading = s.get("since"), s.get("rmse_heading")
    return (
        track.name,
        track.verdict.status,
        _short(s.get("mean_anees")),
        inflation(track),
        s.get("subset") or "–",
        "–" if since is None else str(since),
        number(s.get("rmse_position"), ".3f"),
        number(None if heading is None else np.rad2deg(heading), ".2f"),
        number(s.get("nis_ratio"), ".3f"),
        f"{len(s['failures'])} of {s['runs']}",
    )


def inflation(track: Track) -> str:
    """Factor that makes the stated covariance that of the errors, with its interval."""
    s = track.verdict.statistics
    ratio, (low, high) = s.get("ratio"), s.get("ratio_interval", (0.0, np.inf))
    if ratio is None or not np.isfinite(ratio):
        return "–"
    return f"×{_short(ratio)} [{_short(low)}, {_short(high)}]"


def _short(value: float | None) -> str:
    if value is None or np.isnan(value):
        return "–"
    if value == 0 or not np.isfinite(value):
        return "∞" if value else "0"
    return short(value)


def figure_row(track: Track) -> tuple[str, ...]:
    """Cells of the table of further figures, as FIGURE_COLUMNS."""
    s = track.verdict.statistics
    low, high = s.get("acceptance", (None, None))
    expected = s.get("nis_interval", (np.nan, np.nan))
    covered = s.get("coverage", ())
    detectable = number(s.get("detectable"), ".2g")
    return (
        track.name,
        "–" if low is None or np.isnan(low) else f"{_short(low)} to {_short(high)}",
        detectable if detectable == "–" else f"×{detectable}",
        " / ".join(number(100 * c, ".1f") for c in covered) if np.isfinite(covered).any() else "–",
        number(s.get("nci"), ".1f"),
        number(s.get("inclination"), "+.1f"),
        f"{number(s.get('nis_ratio'), '.3f')} ({number(expected[0], '.3f')} to {number(expected[1], '.3f')})",
    )


def answer_cell(answer: dict[str, Any] | None) -> tuple[str, str]:
    """Mark and corrected p value of one filter's answer to one question."""
    if answer is None:
        return NOT_ASKED, ""
    p = float(answer["adjusted"])
    return FOUND if answer["found"] else NOT_FOUND, "< 1e-6" if p < SMALLEST else f"{p:.2g}"


def answer(studies: Sequence[Study], findings: Sequence[dict[str, Any]]) -> str:
    """Who is honest and who is not, in one paragraph."""
    pairs = [(track, study) for study in studies for track in study.tracks]
    text = []
    if pairs:
        honest = sum(track.verdict.consistent for track, _ in pairs)
        one = honest == 1 or len(pairs) == 1
        passed = ("is" if one else "are") + " honest about the uncertainty of the pose"
        if not any(study.has_truth for study in studies):
            passed = ("passes" if one else "pass") + " the test of the innovations, the only one without truth"
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


CALIBRATION_COLUMNS = (
    "True / stated covariance",
    "Runs",
    "Promised",
    "Gates",
    "Measured",
    "Worst world",
    "99 % interval there",
)


def calibration_groups(c: Calibration) -> list[tuple[str, list[tuple[str, ...]]]]:
    """The appendix: what is counted, and for each promise about it, in all its worlds, cells as CALIBRATION_COLUMNS."""
    return [
        (f"{name}: {about.replace('`', '')}", [_promise_row(p) for p in c.promises if p.question == name])
        for name, about in c.questions.items()
    ]


def _promise_row(promise: Promise) -> tuple[str, ...]:
    worst, best = promise.worst, promise.best
    low, high = worst.interval
    several = len(promise.rates) > 1
    ends = [f"{100 * rate.measured:.1f}" for rate in (best, worst)]
    gates = {rate.gates for rate in promise.rates}
    each = f"{min(gates)}" if len(gates) == 1 else f"{min(gates)} to {max(gates)}"
    return (
        "1, right" if worst.ratio == 1.0 else f"{worst.ratio:.3g}",
        str(worst.runs) if worst.looks else f"{worst.mean_runs:.0f}, {worst.runs} at most",
        f"{'≤' if worst.at_most else '≥'} {100 * worst.promised:g} %",
        f"{each} in {len(promise.rates)} worlds" if several else each,
        f"{' to '.join(dict.fromkeys(ends))} %",
        worst.world,
        f"{100 * low:.1f} to {100 * high:.1f} %",
    )
