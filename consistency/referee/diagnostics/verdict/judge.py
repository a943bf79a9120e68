"""The verdict on a record: on its errors and innovations, and on what it has beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from consistency.referee.diagnostics.questions.innovation_causes import innovation_causes
from consistency.referee.diagnostics.questions.scale import ratio_interval, run_means
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.records.sample import ATTITUDE, innovations_of
from consistency.referee.diagnostics.verdict.answers import SHARES
from consistency.referee.diagnostics.verdict.parts import Guess, Scale, Settings, Verdict
from consistency.referee.diagnostics.verdict.verdict import DEFAULT, judge_alone
from consistency.referee.diagnostics.words.sentences import percent, plain

if TYPE_CHECKING:
    from consistency.referee.diagnostics.planning.early_stopping import Design


def judge(record: Record, settings: Settings = DEFAULT) -> Verdict:
    """Judge one filter: a status of ``records.STATUSES``, with reasons.

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
    is no fault, as with ``allow="conservative"``. *Consistent* is still shown on both sides, after adding the largest
    share of the NEES that the fit may have absorbed (``Record.unseen``). Questions that cannot be answered after the
    fit (``Record.unavailable``) are not asked.

    A map is judged likewise, with its landmarks in the place of steps (``Record.landmarks``) and with the NEES of
    pose and map together, where it is given.

    Raises
    ------
    ValueError
        Nothing to judge is given, or shapes or options do not fit.
    """
    return with_map(judge_runs(record, settings), record.ends, settings)


def judge_runs(record: Record, settings: Settings = DEFAULT, design: Design | None = None) -> Verdict:
    """:func:`judge` without the maps; with a ``design``, the verdict of the look that decides, or of the last one."""
    if design is not None:
        from consistency.referee.diagnostics.planning.early_stopping import follow

        return of_look(*follow(design, record.first_runs, len(record.run_numbers)), record, design)
    if record.guesses:
        return _judge_guesses(record, settings)
    runs, truth = record.as_runs, None
    if record.truth_covariance is not None:
        from consistency.referee.diagnostics.imperfect_truth.uncertain_truth import uncertain_truth

        if (truth := uncertain_truth(record)) is not None:
            runs, record = truth.evidence, replace(record, unshown=record.unshown or truth.unjudged)
    if record.unshown:
        runs = replace(runs, unavailable=tuple(SHARES))
    world = None if record.world is None else judge_alone(record.in_world, settings)
    if not runs.parts:
        return _beside(judge_alone(runs, settings, truth=truth), record, world)
    from consistency.referee.diagnostics.verdict.separate_components import judge_parts

    return _beside(judge_parts(runs, settings), record, world)


def of_look(verdict: Verdict, runs: int, record: Record, design: Design) -> Verdict:
    """The verdict of a look at the first ``runs``, with what is known beside them."""
    from consistency.referee.diagnostics.planning.early_stopping import follow

    world = None if record.world is None else follow(design, record.in_world.first_runs, runs)[0]
    return _beside(verdict, record, world, runs)


def with_map(verdict: Verdict, ends: Record, settings: Settings, design: Design | None = None) -> Verdict:
    """The verdict with that on the maps, which are read for it; a look has their scores alone.

    Parameters
    ----------
    ends : :attr:`Record.ends`, so that the arrays of the runs can be free before the maps are read
    """
    landmarks = None if ends.map is None else ends.map()
    if landmarks is None:
        return verdict
    from consistency.referee.diagnostics.maps.map_nees import map_score

    of_map = None
    if design is not None:
        landmarks = landmarks.of_runs(1 + int(ends.run_numbers[: verdict.runs].max(initial=-1)))
    elif (record := landmarks.record(None if ends.nees is None else ends.nees[:, 0])) is not None:
        of_map = judge_alone(record, settings)
    score = map_score(landmarks.run, landmarks.nees, landmarks.dof)
    return replace(verdict, map=replace(score, verdict=of_map))


def _beside(verdict: Verdict, r: Record, world: Verdict | None, runs: int | None = None) -> Verdict:
    """The verdict with what the record says beside its arrays; ``runs`` of it were judged, or all."""
    verdict = _unshown(verdict, r.unshown)
    rejection = None
    if r.rejections is not None:
        from consistency.referee.diagnostics.maps.rejected_observations import rejection_score

        rejection = rejection_score(*r.rejections.of_runs(runs)[1:])
    first, *rest = verdict.reasons
    left_out = verdict.left_out_steps
    causes, scale, innovations = list(r.causes), verdict.scale, innovations_of(r)
    if innovations is not None:
        causes += innovation_causes(*innovations, float("nan") if scale is None else scale.mean_anees / scale.dof)
    return replace(
        verdict,
        reasons=(f"{first}; {r.caption}" if r.caption else first, *rest, *causes, *_other_ways(verdict, r)),
        causes=tuple(causes),
        convention=r.convention or None,
        align=(r.align or None) if r.convention else None,
        notes=tuple(r.notes),
        left_out_steps=tuple(sorted({*left_out, *r.left_out_steps})) if r.align else left_out,
        world=world,
        rejection=rejection,
    )


def _unshown(verdict: Verdict, why: str) -> Verdict:
    """Undecided, for that reason; as it was without one, or where a window failed."""
    if not why or verdict.scale is None or verdict.status == "failed":
        return verdict
    scale = _not_shown(verdict.scale)
    provided = "" if verdict.truth is not None else " if they are"
    ratio = f"the covariance ratio would be {plain(scale.inflation)}{provided}, reported and not judged"
    reasons = (f"undecided: {why}; {ratio}", *verdict.reasons[1:])
    return replace(verdict, status="undecided", scale=scale, reasons=reasons)


def _not_shown(scale: Scale) -> Scale:
    return replace(scale, equivalence=replace(scale.equivalence, p_value=float("nan"), runs=None))


def _other_ways(verdict: Verdict, r: Record) -> list[str]:
    """What else would decide on a single log of poses."""
    is_log = len(r.run_numbers) == 1 and r.window is None and r.align and r.convention
    if verdict.status != "undecided" or not is_log or not ATTITUDE & set(r.axes):
        return []
    return [
        "--relative 10s (or steps, or metres) makes many windows of one log, if the file has motions with covariances, "
        "or poses with cross-covariances (docs/files.md)"
    ]


# --- errors whose convention nobody declared ---------------------------------------------------------


def _judge_guesses(record: Record, settings: Settings) -> Verdict:
    """Undecided, with every convention that is not rejected at ``settings.false_alarm``, and its ratio.

    The right convention is rejected with that probability at most, whichever it is. The intervals of the ratio hold
    together with that of the rest: of K conventions, each at 1 - false_alarm / K (Bonferroni).

    Parameters
    ----------
    record : with the same runs under each convention (:attr:`Record.guesses`); the first is the default of the files
    """
    verdicts = {kind: judge_runs(one, settings) for kind, one in record.guesses.items()}
    confidence = 1.0 - settings.false_alarm / len(verdicts)
    found = {kind: _guess(record.guesses[kind], v, confidence) for kind, v in verdicts.items()}
    first = next(iter(verdicts.values()))
    return replace(
        first, status="undecided", scale=None if first.scale is None else _not_shown(first.scale), answers=(),
        guesses=found, convention=None, notes=tuple(record.notes),
        reasons=(f"undecided: {_sentence(found, settings)}", *(f"if the error is {kind}: {v.reasons[0]}"
                                                               for kind, v in verdicts.items())),
    )  # fmt: skip


def _guess(record: Record, verdict: Verdict, confidence: float) -> Guess:
    runs = record.as_runs
    assert runs.nees is not None
    means, counts = run_means(runs.nees)
    ratio = ratio_interval(means[counts > 0] / runs.dof, runs.dof, confidence)
    return Guess(verdict.status, verdict.faults, ratio, not verdict.faults and verdict.status != "failed")


def _sentence(found: Mapping[str, Guess], settings: Settings) -> str:
    left = [f"{kind} (covariance ratio {plain(guess.ratio)})" for kind, guess in found.items() if guess.possible]
    rate = percent(settings.false_alarm)
    if not left:
        return f"no error is declared, and at a rate of {rate} each all are rejected: {', '.join(found)}"
    gone = [kind for kind, guess in found.items() if not guess.possible]
    rest = f"; rejected: {', '.join(gone)}" if gone else ""
    return (
        f"no error is declared; not rejected at a rate of {rate}: {', '.join(left)}{rest}. The filter's documentation "
        "says which it is; declare it with --error"
    )
