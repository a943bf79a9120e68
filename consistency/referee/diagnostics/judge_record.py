"""The verdict on a record, once or at growing numbers of runs: the one place that decides."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import takewhile
from typing import TYPE_CHECKING, NamedTuple

from consistency.referee.diagnostics.judging.record_findings import Inspection, findings_of
from consistency.referee.diagnostics.judging.status import deciding_axis
from consistency.referee.diagnostics.questions.sample import sample_of
from consistency.referee.diagnostics.questions.scale import ratio_interval, run_means
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.statistics.nees import e_process, ever
from consistency.referee.diagnostics.verdict.answers import MAIN, SHARES, Settings
from consistency.referee.diagnostics.verdict.parts import RejectionScore, Scale
from consistency.referee.diagnostics.verdict.verdict import ConventionResult, Findings, MapScore, Verdict
from consistency.referee.diagnostics.words.sentences import (
    LATER,
    details,
    other_ways,
    reasons,
    sentences_of_conventions,
    unshown_sentence,
)

if TYPE_CHECKING:
    from consistency.referee.diagnostics.planning.early_stopping import Design

DEFAULT = Settings()


def judge(
    record: Record, settings: Settings = DEFAULT, design: Design | None = None, keep_record: bool = False
) -> Verdict:
    """Judge one filter: consistent, overconfident, conservative, biased, undecided, ..., with reasons.

    Runs are independent, steps are not: every test takes a run as one observation, or holds under any
    dependence between steps. A filter whose errors are Gaussian with the stated covariance is found at fault in
    any of the questions (``consistency.referee.diagnostics.verdict.answers``) with probability ``false_alarm`` at most;
    half of that belongs to the mean NEES, for which :func:`gate_runs` plans. A filter is *consistent* if no question
    found a fault, and two one-sided tests put the ratio of true to stated covariance inside [1 / detect, detect]; with
    ``lost``, the share of lost runs is shown to be at most that, too. Without a fault and without this evidence, the
    filter is undecided. A filter with failed runs is never consistent.

    Innovations are judged where an optimal gain is declared, otherwise they are reported: only those of an optimal gain
    are white. Without truth they are judged alone.

    If a fit to the truth absorbed an unknown part of the errors (``Record.reduced``), a covariance that is too large
    is not a fault, as with ``allow="conservative"``. *Consistent* is still shown on both sides, after adding the
    largest share of the NEES that the fit may have absorbed (``Record.unseen``). Questions that cannot be answered
    after the fit (``Record.unavailable``) are not asked.

    A map is judged likewise, with its landmarks in the place of steps (``Record.landmarks``) and with the NEES of
    pose and map together, where it is given.

    Parameters
    ----------
    design : plan of looks at growing numbers of runs, in place of the settings; the verdict is that of the look that
        decides, or of the last one
    keep_record : keep the record with the verdict, which can then be drawn

    Raises
    ------
    ValueError
        Nothing to judge is given, or shapes or options do not fit.
    """
    if design is not None:
        return follow(design, record.first_runs, len(record.run_numbers))[0]
    if record.guesses:
        return _judge_conventions(record, settings, keep_record)
    evidence, truth, unshown = record.as_runs, None, record.unshown
    if record.truth_covariance is not None:
        from consistency.referee.diagnostics.imperfect_truth.uncertain_truth import uncertain_truth

        truth = uncertain_truth(record)
    if truth is not None:
        evidence, unshown = truth.evidence, record.unshown or truth.unjudged
    if unshown:
        evidence = replace(evidence, unavailable=tuple(SHARES))
    if evidence.parts:
        from consistency.referee.diagnostics.judging.separate_components import findings_of_parts

        found = findings_of_parts(evidence, settings, verdict_of)
    else:
        found = findings_of(evidence, settings, truth=truth)
    first = ""
    if unshown and found.scale is not None and found.status != "failed":
        found = replace(found, status="undecided", scale=_not_shown(found.scale))
        first = unshown_sentence(found, unshown)
    world = None
    if record.world is not None:
        world = verdict_of(findings_of(record.in_world, settings))
    beside = Beside(world, _map_of(record, settings), _rejections_of(record, None), record if keep_record else None)
    return _whole(record, found, first, beside)


class Beside(NamedTuple):
    """What a verdict says beside the errors and innovations."""

    world: Verdict | None
    map: MapScore | None
    rejection: RejectionScore | None
    record: Record | None = None


def verdict_of(found: Findings, first: str = "") -> Verdict:
    """The verdict on errors and innovations alone; ``first`` stands in the place of the first sentence."""
    return Verdict(
        **vars(found), reasons=tuple(reasons(found, first)), details=tuple(details(found)), axis=deciding_axis(found)
    )


def _not_shown(scale: Scale) -> Scale:
    """The scale of which nothing can be shown."""
    return replace(scale, equivalence=replace(scale.equivalence, p_value=float("nan"), runs=None))


def _whole(record: Record, found: Findings, first: str, beside: Beside) -> Verdict:
    """The whole verdict: the findings in words, and what the record says beside its arrays."""
    sentence, *figures = reasons(found, first)
    if record.caption:
        sentence = f"{sentence}; {record.caption}"
    convention = align = None
    if record.convention:
        convention, align = record.convention, record.align or None
    left_out = set(found.left_out_steps)
    if record.align:
        left_out.update(record.left_out_steps)
    causes = (*record.causes, *_causes_of_innovations(record, found))
    fields = vars(found) | {"left_out_steps": tuple(sorted(left_out))}
    return Verdict(
        **fields,
        reasons=(sentence, *figures, *causes, *other_ways(found.status, record)),
        details=tuple(details(found)),
        axis=deciding_axis(found),
        convention=convention,
        align=align,
        notes=tuple(record.notes),
        causes=causes,
        **beside._asdict(),
    )


def _causes_of_innovations(record: Record, found: Findings) -> list[str]:
    """Probable mix-ups of the innovations; their modules are loaded for a record that has some."""
    if record.nis is None and record.innovations is None:
        return []
    from consistency.referee.diagnostics.questions.innovations import innovation_causes, nis_and_dof

    innovations, nees_ratio = nis_and_dof(record), float("nan")
    if innovations is None:
        return []
    if found.scale is not None:
        nees_ratio = found.scale.mean_anees / found.scale.dof
    return innovation_causes(*innovations, nees_ratio)


def _map_of(record: Record, settings: Settings | None) -> MapScore | None:
    """Score of the maps, which are read for it, with the verdict on them; without settings the score alone."""
    if record.map is None:
        return None
    landmarks = record.map()
    if landmarks is None:
        return None
    from consistency.referee.diagnostics.maps.map_nees import last_nees, map_score

    if settings is None:
        landmarks = landmarks.of_runs(_end_of_runs(record))
        return map_score(landmarks.run, landmarks.nees, landmarks.dof)
    verdict, of_map = None, landmarks.record(last_nees(record))
    if of_map is not None:
        verdict = verdict_of(findings_of(of_map, settings))
    return map_score(landmarks.run, landmarks.nees, landmarks.dof, verdict)


def _rejections_of(record: Record, runs: int | None) -> RejectionScore | None:
    """What a guard rejected in the first runs, or in all."""
    if record.rejections is None:
        return None
    from consistency.referee.diagnostics.maps.rejected_observations import rejection_score

    _, *counts = record.rejections.of_runs(runs)
    return rejection_score(*counts)


def _end_of_runs(record: Record) -> int:
    """One more than the largest number of a run."""
    return 1 + int(record.run_numbers.max(initial=-1))


# --- errors whose convention nobody declared ---------------------------------------------------------


def _judge_conventions(record: Record, settings: Settings, keep_record: bool) -> Verdict:
    """Undecided, with every convention that is not rejected at ``settings.false_alarm``, and its ratio.

    The right convention is rejected with that probability at most, whichever it is. The intervals of the ratio hold
    together with that of the rest: of K conventions, each at 1 - false_alarm / K (Bonferroni).

    Parameters
    ----------
    record : with the same runs under each convention (:attr:`Record.guesses`); the first is the default of the files
    """
    verdicts = {kind: judge(one, settings) for kind, one in record.guesses.items()}
    confidence = 1.0 - settings.false_alarm / len(verdicts)
    found = {}
    for kind, verdict in verdicts.items():
        runs = record.guesses[kind].as_runs
        assert runs.nees is not None
        means, counts = run_means(runs.nees)
        ratio = ratio_interval(means[counts > 0] / runs.dof, runs.dof, confidence)
        possible = not verdict.faults and verdict.status != "failed"
        found[kind] = ConventionResult(verdict.status, verdict.faults, ratio, possible)
    first = next(iter(verdicts.values()))
    scale = first.scale
    if scale is not None:
        scale = _not_shown(scale)
    return replace(
        first,
        status="undecided",
        scale=scale,
        answers=(),
        guesses=found,
        convention=None,
        notes=tuple(record.notes),
        reasons=tuple(sentences_of_conventions(found, verdicts, settings)),
        record=record if keep_record else None,
    )


# --- looks at growing numbers of runs ------------------------------------------------------------------


def look(design: Design, evidence: Record, spent: float | None) -> Verdict:
    """The verdict at one inspection: `undecided` means that the runs continue.

    A filter without truth is judged by its innovations, at looks only.
    """
    found, first = _inspected(design, evidence, spent)
    return _of_look(design, evidence, _end_of_runs(evidence), found, first)


def speaks(design: Design, evidence: Record, spent: float | None) -> bool:
    """Whether this inspection can decide. Between looks only a fault of the scale does."""
    return spent is not None or _p_of_scale(design, evidence) <= SHARES[MAIN] * design.false_alarm


def follow(design: Design, evidence_of: Callable[[int], Record], limit: int | None = None) -> tuple[Verdict, int]:
    """Inspect runs until decided; return the verdict and the number of runs used.

    Parameters
    ----------
    evidence_of : function that returns the first k runs of a filter
    limit : number of available runs; the last inspection within it decides, or all runs if they are fewer than 12
    """
    for runs, spent, is_last in _inspections(design, limit):
        evidence = evidence_of(runs)
        if not is_last and not speaks(design, evidence, spent):
            continue
        found, first = _inspected(design, evidence, spent)
        if is_last or found.status != "undecided":
            return _of_look(design, evidence, runs, found, first), runs
    raise AssertionError("unreachable: a design without a last look is endless")


def looks(
    design: Design, filters: Sequence[str], read: Callable[[int, str], Record], decided: dict[str, Verdict]
) -> Iterator[int]:
    """Yield the number of runs of each inspection, look when they are there, and end when all ``filters`` are decided.

    Parameters
    ----------
    read : record of the first runs of a filter, by their number and its name
    decided : where verdicts go, by filter
    """
    for runs, spent in design.inspections():
        yield runs
        for name in [name for name in filters if name not in decided]:
            verdict = _look_at(design, read(runs, name), runs, spent)
            if verdict is not None and (verdict.status != "undecided" or runs == design.max_runs):
                decided[name] = verdict
        if len(decided) == len(filters):
            return


def _look_at(design: Design, record: Record, runs: int, spent: float | None) -> Verdict | None:
    """What is said after so many runs; None where it is not the time to ask."""
    some = record.first_runs(runs)
    if runs != design.max_runs and not speaks(design, some, spent):
        return None
    return look(design, some, spent)


def _inspections(design: Design, limit: int | None) -> Iterator[tuple[int, float | None, bool]]:
    """Runs and share of each inspection, and whether it is the last one."""
    if limit is None:
        for runs, spent in design.inspections():
            yield runs, spent, runs == design.max_runs
        return
    within = list(takewhile(lambda each: each[0] <= limit, design.inspections()))
    if not within:
        within = [(limit, next(design.inspections())[1])]
    for runs, spent in within:
        yield runs, spent, (runs, spent) == within[-1]


def _inspected(design: Design, evidence: Record, spent: float | None) -> tuple[Findings, str]:
    """Findings of an inspection, and the sentence of one that cannot decide; '' of any other."""
    inspection = Inspection(spent, _p_of_scale(design, evidence))
    found = findings_of(evidence, design.settings, inspection)
    if spent is None and found.consistent:
        return replace(found, status="undecided"), LATER
    return found, ""


def _of_look(design: Design, record: Record, runs: int, found: Findings, first: str) -> Verdict:
    """The verdict of a look at the first ``runs``, with what is known beside them."""
    world = None
    if record.world is not None:
        errors = replace(record.in_world, map=None, rejections=None, caption="", causes=(), notes=(), convention="")
        world, _ = follow(design, errors.first_runs, runs)
    return _whole(record, found, first, Beside(world, _map_of(record, None), _rejections_of(record, runs)))


def _p_of_scale(design: Design, evidence: Record) -> float:
    """p value of the scale, valid at any time; 1 without truth."""
    sample = sample_of(evidence, design.settings)
    if sample is None:
        return 1.0
    return ever(e_process(sample.means(), sample.dof).both)


def progress_text(decided: Mapping[str, Verdict], filters: Sequence[str]) -> str:
    parts = [f"{name} {verdict.status}" for name, verdict in decided.items()]
    return ", ".join(parts + [f"{name} open" for name in filters if name not in decided])
