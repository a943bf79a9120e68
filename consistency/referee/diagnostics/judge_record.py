"""The verdict on a record, once or at growing numbers of runs: the one place that decides."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import takewhile
from typing import TYPE_CHECKING, Any

from consistency.referee.diagnostics.nees import e_processes, ever
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.record_findings import InterimLook, findings_of
from consistency.referee.diagnostics.sample import sample_of
from consistency.referee.diagnostics.scale import ratio_interval, run_means
from consistency.referee.diagnostics.sentences import details, other_ways, reasons, same_truth, sentences_of_conventions
from consistency.referee.diagnostics.status import deciding_axis
from consistency.referee.diagnostics.verdict import ConventionResult, Findings, MapScore, Verdict
from consistency.referee.diagnostics.verdict_parts import MAIN, SHARES, RejectionScore, Settings

if TYPE_CHECKING:
    from consistency.referee.diagnostics.planning import Design

DEFAULT = Settings()


def judge(
    record: Record, settings: Settings = DEFAULT, design: Design | None = None, keep_record: bool = False
) -> Verdict:
    """Judge one filter: consistent, overconfident, conservative, biased, undecided, ..., with reasons.

    Runs are independent, steps are not: every test takes a run as one observation, or holds under any
    dependence between steps. A filter whose errors are Gaussian with the stated covariance is found at fault in
    any of the questions (``consistency.referee.diagnostics.verdict_parts``) with probability ``false_alarm`` at most;
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
    kept = None
    if keep_record:
        kept = record
    if design is not None:
        return follow(design, record.first_runs, len(record.run_numbers), kept)[0]
    if record.guesses:
        return _judge_conventions(record, settings, kept)
    if record.errors.bounded:
        from consistency.referee.diagnostics.bounds import findings_of_bounds

        return _whole(record, findings_of_bounds(record, settings), kept)
    evidence = record.as_runs
    truth = None
    unshown = record.origin.unshown
    if record.truth.covariance is not None:
        from consistency.referee.diagnostics.uncertain_truth import uncertain_truth

        truth = uncertain_truth(record)
    if truth is not None:
        evidence = truth.evidence
        unshown = record.origin.unshown or truth.unjudged
    if evidence.errors.parts:
        from consistency.referee.diagnostics.record_findings import findings_of_parts

        found = findings_of_parts(evidence, settings, unshown)
    else:
        found = findings_of(evidence, settings, truth=truth, unshown=unshown)
    world = None
    if record.world is not None:
        world = _verdict(findings_of(record.in_world, settings))
    return _whole(record, found, kept, world, _map_of(record, settings), _rejections_of(record))


def _verdict(found: Findings) -> Verdict:
    """The findings with the sentences that say them."""
    return Verdict(**_in_words(found), reasons=tuple(reasons(found)))


def _in_words(found: Findings) -> dict[str, Any]:
    """Fields of a verdict that follow from its findings, but for the reasons."""
    parts = {name: _verdict(part) for name, part in found.parts.items()}
    return {**vars(found), "parts": parts, "details": tuple(details(found)), "axis": deciding_axis(found)}


def _whole(
    judged: Record,
    found: Findings,
    kept: Record | None,
    world: Verdict | None = None,
    map: MapScore | None = None,
    rejection: RejectionScore | None = None,
) -> Verdict:
    """The verdict on a record: its findings in words, and what stands beside its errors and innovations."""
    sentence, *figures = reasons(found)
    if judged.fit.caption:
        sentence = f"{sentence}; {judged.fit.caption}"
    convention = align = None
    if judged.errors.convention:
        convention = judged.errors.convention
        align = judged.fit.align or None
    left_out = set(found.left_out_steps)
    if judged.fit.align:
        left_out.update(judged.left_out_steps)
    causes = (*judged.origin.causes, *_causes_of_innovations(judged, found))
    if not causes and found.status == "conservative":
        from consistency.referee.diagnostics.fault_words import level_causes

        causes = tuple(level_causes(found))
    return Verdict(
        **_in_words(found) | {"left_out_steps": tuple(sorted(left_out))},
        reasons=(sentence, *figures, *causes, *same_truth(judged, found), *other_ways(found.status, judged)),
        convention=convention,
        align=align,
        notes=tuple(judged.origin.notes),
        causes=causes,
        world=world,
        map=map,
        rejection=rejection,
        record=kept,
    )


def _causes_of_innovations(record: Record, found: Findings) -> list[str]:
    """Probable mix-ups of the innovations; their modules are loaded for a record that has some."""
    if record.innovations.nis is None and record.innovations.values is None:
        return []
    from consistency.referee.diagnostics.whiteness import innovation_causes, nis_and_dof

    innovations = nis_and_dof(record)
    nees_ratio = float("nan")
    if innovations is None:
        return []
    if found.scale is not None:
        nees_ratio = found.scale.mean_anees / found.scale.dof
    return innovation_causes(*innovations, nees_ratio)


def _map_of(record: Record, settings: Settings | None = None) -> MapScore | None:
    """Score of the maps, which are read for it, with the verdict on them; without settings the score alone."""
    if record.map.read is None:
        return None
    landmarks = record.map.read()
    if landmarks is None:
        return None
    from consistency.referee.diagnostics.maps import last_nees, map_score

    if settings is None:
        landmarks = landmarks.of_runs(_end_of_runs(record))
        return map_score(landmarks.run, landmarks.nees, landmarks.dof)
    verdict = None
    of_map = landmarks.record(last_nees(record))
    if of_map is not None:
        verdict = _verdict(findings_of(of_map, settings))
    return map_score(landmarks.run, landmarks.nees, landmarks.dof, verdict)


def _rejections_of(record: Record, runs: int | None = None) -> RejectionScore | None:
    """What a guard rejected in the first runs, or in all."""
    if record.map.rejections is None:
        return None
    from consistency.referee.diagnostics.maps import rejection_score

    _, *counts = record.map.rejections.of_runs(runs)
    return rejection_score(*counts)


def _end_of_runs(record: Record) -> int:
    """One more than the largest number of a run."""
    return 1 + int(record.run_numbers.max(initial=-1))


# --- errors whose convention nobody declared ---------------------------------------------------------


def _judge_conventions(record: Record, settings: Settings, kept: Record | None) -> Verdict:
    """Undecided, with every convention that is not rejected at ``settings.false_alarm``, and its ratio.

    The right convention is rejected with that probability at most, whichever it is. The intervals of the ratio hold
    together with that of the rest: of K conventions, each at 1 - false_alarm / K (Bonferroni).

    Parameters
    ----------
    record : with the same runs under each convention (:attr:`Record.guesses`); the first is the default of the files
    """
    verdicts = {kind: judge(one, settings) for kind, one in record.guesses.items()}
    confidence = 1.0 - settings.false_alarm / len(verdicts)
    results = {}
    for kind, verdict in verdicts.items():
        runs = record.guesses[kind].as_runs
        assert runs.errors.nees is not None
        means, counts = run_means(runs.errors.nees)
        ratio = ratio_interval(means[counts > 0] / runs.errors.dof, runs.errors.dof, confidence)
        possible = not verdict.faults and verdict.status != "failed"
        results[kind] = ConventionResult(verdict.status, verdict.faults, ratio, possible)
    first = next(iter(verdicts.values()))
    of_first = vars(first) | {
        "status": "undecided",
        "scale": first.scale and first.scale.not_shown,
        "answers": (),
        "guesses": results,
        "convention": None,
        "notes": tuple(record.origin.notes),
        "reasons": tuple(sentences_of_conventions(results, verdicts, settings)),
        "record": kept,
    }
    return Verdict(**of_first)


# --- looks at growing numbers of runs ------------------------------------------------------------------


def look(design: Design, evidence: Record, spent: float | None) -> Verdict:
    """The verdict at one inspection: `undecided` means that the runs continue.

    A filter without truth is judged by its innovations, at looks only.
    """
    return _of_look(design, evidence, _end_of_runs(evidence), _inspected(design, evidence, spent))


def speaks(design: Design, evidence: Record, spent: float | None) -> bool:
    """Whether this inspection can decide. Between looks only a fault of the scale does."""
    return spent is not None or max(_p_of_scale(design, evidence)) <= SHARES[MAIN] * design.false_alarm


def follow(
    design: Design, evidence_of: Callable[[int], Record], limit: int | None = None, kept: Record | None = None
) -> tuple[Verdict, int]:
    """Inspect runs until decided; return the verdict and the number of runs used.

    Parameters
    ----------
    evidence_of : function that returns the first k runs of a filter
    limit : number of available runs; the last inspection within it decides, or all runs if they are fewer than 12
    kept : record of all runs, kept with the verdict to be drawn
    """
    for runs, spent, is_last in _inspections(design, limit):
        verdict = _decision(design, evidence_of(runs), runs, spent, is_last, kept)
        if verdict is not None:
            return verdict, runs
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
    for runs, spent, is_last in _inspections(design, None):
        yield runs
        for name in filters:
            if name in decided:
                continue
            evidence = read(runs, name).first_runs(runs)
            verdict = _decision(design, evidence, _end_of_runs(evidence), spent, is_last)
            if verdict is not None:
                decided[name] = verdict
        if len(decided) == len(filters):
            return


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


def _decision(
    design: Design, evidence: Record, runs: int, spent: float | None, is_last: bool, kept: Record | None = None
) -> Verdict | None:
    """The verdict of an inspection of the first ``runs``; None where the runs continue."""
    if not is_last and not speaks(design, evidence, spent):
        return None
    found = _inspected(design, evidence, spent)
    if not is_last and found.status == "undecided":
        return None
    return _of_look(design, evidence, runs, found, kept)


def _inspected(design: Design, evidence: Record, spent: float | None) -> Findings:
    """Findings of an inspection."""
    p_values = _p_of_scale(design, evidence)
    return findings_of(evidence, design.settings, InterimLook(spent, max(p_values), p_values[0]))


def _of_look(design: Design, evidence: Record, runs: int, found: Findings, kept: Record | None = None) -> Verdict:
    """The verdict of a look at the first ``runs``, with what is known beside them."""
    world = None
    if evidence.world is not None:
        of_world = evidence.in_world.errors_alone
        errors = replace(
            of_world, fit=replace(of_world.fit, caption=""), origin=replace(of_world.origin, causes=(), notes=())
        )
        world, _ = follow(design, errors.first_runs, runs)
    return _whole(evidence, found, kept, world, _map_of(evidence), _rejections_of(evidence, runs))


def _p_of_scale(design: Design, evidence: Record) -> list[float]:
    """p values of the scale by each of the :func:`e_processes`, valid at any time; 1 without truth."""
    sample = sample_of(evidence, design.settings)
    if sample is None:
        return [1.0]
    return [ever(bets.both) for bets in e_processes(sample.means(), sample.dof, sample.early_means)]


def progress_text(decided: Mapping[str, Verdict], filters: Sequence[str]) -> str:
    parts = [f"{name} {verdict.status}" for name, verdict in decided.items()]
    return ", ".join(parts + [f"{name} open" for name in filters if name not in decided])
