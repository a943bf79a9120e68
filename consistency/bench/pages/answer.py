"""Who is honest and who is not, in one paragraph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from consistency.bench.pages.report_input import Study, Track
from consistency.bench.types import outcome
from consistency.referee.diagnostics.verdict.parts import STATUSES
from consistency.referee.diagnostics.words.sentences import plural
from consistency.referee.document.wording import listed

LISTED = 6  # filters that the first paragraph names one by one


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
    names = [track.name for track, _ in pairs if track.verdict.status == status]
    if not names:
        return ""
    if studies > 1 or len(names) > LISTED:
        return f"{len(names)} {'is' if len(names) == 1 else 'are'} {status} ({STATUSES[status]})."
    return f"{status.capitalize()} ({STATUSES[status]}): {listed(names)}."


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
    said = [outcome(str(finding["source"] or ""), str(finding["verdict"])) for finding in findings]
    own = [verdict for verdict in said if verdict in ("holds", "does not hold")]
    published = [verdict for verdict in said if verdict not in ("holds", "does not hold")]
    parts = []
    if published:
        counts = [f"{published.count(verdict)} {verdict}" for verdict in dict.fromkeys(published)]
        parts.append(f"Of {plural(len(published), 'published finding')}, {listed(counts)}.")
    if own:
        holding = own.count("holds")
        parts.append(f"Of {plural(len(own), 'finding')} of this project, {holding} hold{'s' * (holding == 1)}.")
    return " ".join(parts)
