"""Numbers and records as words, the same in every format."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from consistency.diagnostics import Answer
from consistency.diagnostics.records import STATUSES
from consistency.diagnostics.wording import UNCERTAIN, plural, short
from consistency.reporting.calibration import Calibration, Promise
from consistency.reporting.model import Study, Track

FIGURE_COLUMNS = (
    "Filter",
    "Mean ANEES accepted",
    "Covariance ratio that would be found",
    "2-sigma coverage, all steps (%)",
    "Noncredibility (dB)",
    "Inclination (dB)",
    "NIS / dof (95 % expected)",
)
FOUND, TOLERATED, NOT_FOUND, NOT_ASKED = "✗", "≈", "○", "–"
MARKS = {FOUND: "found", TOLERATED: "found, within the tolerance", NOT_FOUND: "not found", NOT_ASKED: "not asked"}
SMALLEST = 1e-6  # p value below which digits say nothing
LISTED = 6  # pairs of filter and scenario that the first paragraph names one by one


def number(value: Any, form: str) -> str:
    """A number, or a dash where there is none."""
    return "–" if value is None or not np.isfinite(value) else format(float(value), form)


def verdict_columns(study: Study) -> tuple[str, ...]:
    """Heads of the verdict table."""
    return (
        "Filter",
        "Verdict",
        "Mean ANEES",
        "Covariance to multiply by",
        f"Shown inside {equivalence_interval(study)}",
        "Mainly",
        "Since step",
        "RMSE position (m)",
        "RMSE heading (deg)",
        "NIS / dof",
        "Failed runs",
    )


def equivalence_interval(study: Study) -> str:
    """Where consistent filters are shown to have their ratio of true to stated covariance; the same for all."""
    if not study.tracks:
        return ""
    verdict = study.tracks[0].verdict
    factor = verdict.settings.factor if verdict.equivalence is None else verdict.equivalence.factor
    low = "(0" if verdict.settings.one_sided else f"[{short(1.0 / factor)}"
    return f"{low},\u00a0{short(factor)}]"


def verdict_row(track: Track) -> tuple[str, ...]:
    """Cells of the verdict table, as :func:`verdict_columns`."""
    v, location, accuracy = track.verdict, track.verdict.location, track.verdict.accuracy
    since = None if location is None else location.since
    return (
        track.name,
        v.status,
        "–" if v.scale is None else _short(v.scale.mean_anees),
        inflation(track),
        shown_inside(track),
        (location.subset if location is not None else None) or "–",
        "–" if since is None else str(since),
        number(None if accuracy is None else accuracy.rmse_position, ".3f"),
        number(None if accuracy is None else np.rad2deg(accuracy.rmse_heading), ".2f"),
        nis(track),
        f"{len(v.failures)} of {v.runs}",
    )


def inflation(track: Track) -> str:
    """Factor that makes the stated covariance that of the errors, with its interval."""
    scale = track.verdict.scale
    if scale is None or not np.isfinite(scale.inflation.value):
        return "–"
    ratio, low, high = scale.inflation
    known = np.isfinite(high) and high < UNCERTAIN * low
    return f"×{_short(ratio)} [{f'{_short(low)}, {_short(high)}' if known else 'unknown'}]"


def shown_inside(track: Track) -> str:
    """Whether the ratio of true to stated covariance was shown to lie where it should, and the p value."""
    shown = track.verdict.equivalence
    if shown is None or not np.isfinite(shown.p_value):
        return "–"
    return f"{'yes' if shown.shown else 'no'}, p {p_cell(shown.p_value)}"


def nis(track: Track) -> str:
    """NIS per degree of freedom, in parentheses where it is not judged."""
    found = track.verdict.innovations
    ratio = number(None if found is None else found.ratio, ".3f")
    return ratio if track.innovations_judged or ratio == "–" else f"({ratio})"


def _short(value: float | None) -> str:
    if value is None or np.isnan(value):
        return "–"
    if value == 0 or not np.isfinite(value):
        return "∞" if value else "0"
    return short(value)


def figure_row(track: Track) -> tuple[str, ...]:
    """Cells of the table of further figures, as FIGURE_COLUMNS."""
    scale, accuracy = track.verdict.scale, track.verdict.accuracy
    low, high = (np.nan, np.nan) if scale is None else scale.accepted
    detectable = number(None if scale is None else scale.detectable, ".2g")
    covered = np.empty(0) if accuracy is None else accuracy.coverage
    return (
        track.name,
        "–" if np.isnan(low) else f"{_short(low)} to {_short(high)}",
        detectable if detectable == "–" else f"×{detectable}",
        " / ".join(number(100 * c, ".1f") for c in covered) if np.isfinite(covered).any() else "–",
        number(None if accuracy is None else accuracy.nci, ".1f"),
        number(None if accuracy is None else accuracy.inclination, "+.1f"),
        _nis_expected(track),
    )


def _nis_expected(track: Track) -> str:
    found = track.verdict.innovations
    if found is None or not np.isfinite(found.ratio):
        return "–"
    low, high = (number(end, ".3f") for end in found.interval)
    return f"{found.ratio:.3f} ({f'{low} to {high}' if found.judged else 'not judged'})"


def answer_cell(answer: Answer | None) -> tuple[str, str]:
    """Mark, one of MARKS, and corrected p value of one filter's answer to one question."""
    if answer is None:
        return NOT_ASKED, ""
    mark = TOLERATED if answer.tolerated else FOUND if answer.found else NOT_FOUND
    return mark, p_cell(answer.adjusted)


def p_cell(p: float) -> str:
    """A p value as a table has it."""
    return "< 1e-6" if p < SMALLEST else f"{p:.2g}"


def answer(studies: Sequence[Study], findings: Sequence[dict[str, Any]]) -> str:
    """Who is honest and who is not, in one paragraph."""
    pairs = [(track, study) for study in studies for track in study.tracks]
    text = []
    if findings:
        text.append(_finding_sentence(findings))
    if pairs:
        text.append(_count_sentence(studies, [track for track, _ in pairs]))
        text += [sentence for status in STATUSES if (sentence := _status_sentence(status, pairs, len(studies)))]
        text.append(_failure_sentence(studies))
    if any(track.innovations_judged and not study.has_truth for track, study in pairs):
        text.append(
            "Where the truth is not known the innovations alone decide, if the filter declares an optimal gain; they "
            "cannot see most pose errors."
        )
    return " ".join(text) or "This folder holds neither results nor findings."


def _count_sentence(studies: Sequence[Study], tracks: Sequence[Track]) -> str:
    """How many pairs of filter and scenario passed, and what."""
    honest = sum(track.verdict.consistent for track in tracks)
    one = honest == 1 or len(tracks) == 1
    passed = f"{'is' if one else 'are'} shown to be honest about the uncertainty of the pose"
    nothing = False
    if not any(study.has_truth for study in studies):
        passed = f"{'passes' if one else 'pass'} the test of the innovations, the only one without truth"
        nothing = not any(track.innovations_judged for track in tracks)
    unknown = "no filter can be judged: the truth is not known, and none declares an optimal gain"
    if len(studies) == 1:
        size = f"{plural(studies[0].runs, 'run')} of {plural(len(studies[0].steps), 'step')}"
        count = unknown if nothing else f"{honest} of {plural(len(tracks), 'filter')} {passed}"
        return f"In {studies[0].name} ({size}), {count}."
    count = unknown if nothing else f"{honest} {passed}"
    return f"{len(studies)} studies put {len(tracks)} pairs of filter and scenario to the test; {count}."


def _status_sentence(status: str, pairs: list[tuple[Track, Study]], studies: int) -> str:
    by_study: dict[str, list[str]] = {}
    for track, study in pairs:
        if track.verdict.status == status:
            by_study.setdefault(study.name, []).append(track.name)
    if not by_study:
        return ""
    count = sum(map(len, by_study.values()))
    if count > LISTED:
        return f"{count} are {status} ({STATUSES[status]})."
    where = [listed(names) + (f" in {study}" if studies > 1 else "") for study, names in by_study.items()]
    return f"{status.capitalize()} ({STATUSES[status]}): {'; '.join(where)}."


def _failure_sentence(studies: Sequence[Study]) -> str:
    failed = sum(len(study.failures) for study in studies)
    total = sum(study.runs * len(study.tracks) for study in studies)
    if not failed:
        return "No run broke down."
    where = " that looked at them" if any(study.until_decided for study in studies) else ""
    return (
        f"{failed} of {total} runs through a filter broke down; they are listed below and counted in the "
        f"verdicts{where}."
    )


def _finding_sentence(findings: Sequence[dict[str, Any]]) -> str:
    verdicts = [str(finding["verdict"]) for finding in findings]
    counts = [f"{verdicts.count(verdict)} {verdict}" for verdict in dict.fromkeys(verdicts)]
    return f"Of {plural(len(findings), 'finding')}, {listed(counts)}."


def listed(words: Sequence[str]) -> str:
    """a, b and c."""
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)


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
