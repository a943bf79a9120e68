"""The noise model of an odometry at one span: fitted, judged, and told in sentences, a table and numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg, stats

from consistency.referee.defaults import DETECT
from consistency.referee.diagnostics.judge_record import judge
from consistency.referee.diagnostics.number_words import plural, short
from consistency.referee.diagnostics.verdict import Verdict, plain
from consistency.referee.diagnostics.verdict_parts import Interval
from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.covariance_ratios import (
    DECIDE,
    HALF,
    IN_TURN,
    Fold,
    JudgedSpan,
    Ratio,
    folds_of,
    judged_by,
    record_of_motions,
    shown,
    stretches_of,
)
from consistency.referee.fit_covariance.drives import (
    ENOUGH,
    PIECES,
    Drive,
    DriveWindows,
    cut_windows,
    motion_matrices,
    span_of,
    vectors_of,
)
from consistency.referee.fit_covariance.mean_and_noise import (
    NEIGHBOURS,
    STRONG,
    Mean,
    MeanFit,
    WhiteNoise,
    fit_noise,
    jitter_of,
    variance_intervals,
)
from consistency.referee.fit_covariance.refusals import (
    SHARED,
    TERMS,
    MotionDependence,
    PersistentError,
    RotationGrowth,
    SecondErrors,
    doubts,
    errors_of_second,
    mean_by_motion,
    persistent_errors,
    require_poses,
    require_sound,
    rotation_growth,
)
from consistency.referee.geometry import log, matrices
from consistency.referee.readers.truth_matching import Poses
from consistency.referee.show.blocks import Block, Cell, Column, Document, Quantity, Text, table
from consistency.referee.types import Array

SPANS = (1, 2, 5, 10, 20)  # multiples of the span that the fit is judged at
FEWEST = 3  # windows at a span that is shown
RATIO = ("value", "low", "high", "spread", "drives", "windows", "status")  # of a ratio, as programs have it
EVIDENCE = ("low", "high", "free", "instruments", "turns", "strength", "lasts", "is_open")  # of a mean, the same
MARK = {"consistent": "", "undecided": " ?", "overconfident": " overconfident", "conservative": " conservative"}
WRONG = ("overconfident", "conservative")


@dataclass(frozen=True)
class NoiseModel:
    """White noise of an odometry, fitted at one span, with the verdict on motions that chose nothing."""

    name: str
    span: str  # 1m, 2s, 100
    noise: WhiteNoise
    per_m: tuple[Interval, ...]  # (n,), variances a metre
    per_rad: tuple[Interval, ...]  # (n,)
    spans: tuple[JudgedSpan, ...]  # the first is that of the fit
    verdict: Verdict = field(repr=False)  # of the referee on judged motions, each a run
    fitted_drives: tuple[str, ...]
    judged_drives: tuple[str, ...]
    held_out: str  # "in turn", "half" or names
    growth: RotationGrowth  # of the squared rotation error over the span
    warnings: tuple[str, ...]
    lasting: tuple[PersistentError, ...]  # errors that differ between drives
    by_motion: MotionDependence | None  # whether the mean depends on the motion; None where it is left in
    second: SecondErrors | None  # errors of the second estimator
    windows: DriveWindows = field(repr=False)
    folds: tuple[Fold, ...] = field(repr=False)

    @property
    def drives(self) -> tuple[Drive, ...]:
        return self.windows.drives

    @property
    def counts(self) -> Mapping[str, int]:
        """Windows, and those left out: long, still, jumps."""
        return self.windows.counts

    @property
    def ratio(self) -> Ratio:
        """Ratio of true to stated covariance at the span."""
        return self.spans[0].whole

    @property
    def status(self) -> str:
        """consistent, overconfident, conservative, inconsistent or undecided."""
        is_of_truth = self.second is not None and bool(self.second.is_shared.any())
        doubted = is_of_truth or any(each.decides for each in self.lasting)
        return decided(self.spans[0].status, doubted, self.by_motion is not None and self.by_motion.is_found)

    @property
    def stretches(self) -> list[Poses]:
        """Judged motions as files have them."""
        return stretches_of(self.windows, self.folds)

    def correct(self, motions: ArrayLike) -> Array:
        """Estimated motions (K, 3) or (K, 7) with the mean error taken out, as matrices (K, d + 1, d + 1)."""
        return motion_matrices(self.noise.mean.corrected(_motions(motions, self.noise)))

    def covariance(self, motion: ArrayLike) -> Array:
        """Covariance (n, n) of Log(D^-1 M) of a corrected motion D: the error in the body's frame at its end.

        Parameters
        ----------
        motion : x, y, heading (3,) or x, y, z and a quaternion (7,), taken as even; or (K, 3) or (K, 7), its steps

        Raises
        ------
        InputError
            The motion is not of the model's space, or not finite.
        """
        steps = _motions(motion, self.noise)
        if len(steps) == 1:
            steps = equal_pieces(steps[0], PIECES)
        return np.asarray(self.noise.covariance(steps[None])[0])

    def error_windows(self, judged: JudgedSpan) -> DriveWindows:
        """The windows of a span, corrected."""
        found = self.windows.over(span_of(judged.span).size)
        assert found is not None
        return self.noise.mean.applied(found)

    def plot(self, path: str | Path | None = None) -> Any:
        """Errors with ellipses, growth of the squared error over spans, and ratios by drive; needs ``[plot]``.

        Parameters
        ----------
        path : .png, .pdf or .svg to write as well; one that is there is replaced
        """
        from consistency.referee.fit_covariance.pictures import draw_noise
        from consistency.referee.pages.write_pages import plotted

        return plotted(partial(draw_noise, self), path)

    def __repr__(self) -> str:
        return f"<NoiseModel {self.name}: {model_sentence(self)}>"


def decided(status: str, doubted: bool, depends: bool) -> str:
    """A status at the span: nothing is consistent whose errors are the truth's, or last for a whole drive.

    Such an error has one value a drive, so that a fit to few drives, and its judgement, rest on as few values. Where
    the mean ``depends`` on the motion, a covariance that is right on average is wrong for each motion.
    """
    if status != "consistent":
        return status
    if depends:
        return "inconsistent"
    return "undecided" if doubted else status


def fit_covariance(
    records: Sequence[Drive],
    span: str | float,
    *,
    held_out: str | None = None,
    axes: int | None = None,
    correct: bool = True,
    by_turn: bool = False,
    cautious: float | None = None,
    second: Sequence[Drive] | None = None,
    name: str = "odometry",
) -> NoiseModel:
    """Fit a covariance to an odometry that states none, at one span, and judge it on drives that chose nothing.

    Parameters
    ----------
    records : drives with their truth, of :func:`consistency.read_drives` or :func:`consistency.drive_of`
    span : length of the motions: "1m" along the true path, "2s", or 100 steps
    held_out : names of drives that are judged and not fitted, with commas; "half": the second half of every drive is
        judged by a fit to the first halves; None: each drive is judged by a fit to all others, or halves of one
    axes : 3 (x, y, yaw) or 6; None is that of the poses
    correct : take the mean of scale and heading out first
    by_turn : take out a way that each turn adds, too, as of wheels that slip
    cautious : probability, such as 0.9, that a new drive has no larger covariance than the one stated: raises all
    second : another estimator's poses on the same drives, to tell errors of the truth
    name : of the odometry, in sentences

    Raises
    ------
    InputError
        An option is out of its range, or the errors are none that white noise describes: says which, and what to do.
    """
    drives = list(records)
    planar = _is_planar(drives, axes)
    if cautious is not None and not 0.5 < cautious < 1.0:
        raise InputError(f"--cautious {cautious:g}: must be a probability between 0.5 and 1, such as 0.9")
    if by_turn and not correct:
        raise InputError("--by-turn is a correction; leave --keep-mean-error out")
    length = span_of(span)
    require_poses(drives)
    windows = cut_windows(drives, length, planar)
    require_sound(windows, correct)
    jitter = jitter_of(fit_noise(windows, correct, by_turn), windows)
    fit = partial(fit_noise, correct=correct, by_turn=by_turn, jitter=jitter)
    if held_out is None and len(drives) == 1:
        held_out = HALF
    by_halves = held_out == HALF
    noise, folds = folds_of(windows, held_out, fit)
    growth = rotation_growth(windows, noise.mean)
    lasting = persistent_errors(noise, windows)
    if cautious is not None:
        factor = caution(judged_by(folds, windows, not by_halves).whole, cautious)
        noise = replace(noise, factor=factor)
        folds = [replace(fold, noise=replace(fold.noise, factor=factor)) for fold in folds]
    spans = _judge_spans(folds, windows, not by_halves)
    record = record_of_motions(stretches_of(windows, folds), windows.axes)
    judged = np.unique(np.concatenate([fold.judged for fold in folds]))
    fitted = windows
    if held_out not in (None, HALF):
        fitted = windows.of(~np.isin(windows.drive, judged))
    n = len(windows.axes)
    variances = variance_intervals(noise, fitted)
    return NoiseModel(
        name=name,
        span=length.option,
        noise=noise,
        per_m=variances[:n],
        per_rad=variances[n:],
        spans=spans,
        verdict=judge(record, keep_record=True),
        fitted_drives=tuple(drives[i].name for i in np.unique(fitted.drive)),
        judged_drives=tuple(drives[i].name for i in judged),
        held_out=held_out or IN_TURN,
        growth=growth,
        warnings=tuple(doubts(noise, windows, growth, lasting)),
        lasting=lasting,
        by_motion=mean_by_motion(noise, windows) if correct else None,
        second=errors_of_second(noise, windows, second) if second is not None else None,
        windows=windows,
        folds=tuple(folds),
    )


def caution(ratio: Ratio, probability: float) -> float:
    """Factor on a covariance above which the ratio of a new drive is no larger than 1, with that probability.

    The upper prediction limit of a log-normal ratio of drives.

    Raises
    ------
    InputError
        Fewer than ``ENOUGH`` drives are judged, which do not tell their spread.
    """
    if ratio.drives < ENOUGH:
        raise InputError(
            f"--cautious: {ratio.drives} judged drives do not tell how drives differ; it takes {ENOUGH} or more"
        )
    error = ratio.spread * np.sqrt(1.0 + 1.0 / ratio.drives)  # of a new drive
    reach = float(stats.t.ppf(probability, ratio.drives - 1)) * error
    return float(max(1.0, ratio.value * np.exp(reach)))


def equal_pieces(motion: Array, pieces: int) -> Array:
    """Divide a motion (n,) into equal pieces of one screw, (pieces, n)."""
    T = motion_matrices(motion[None])
    twist = log(T)[0] / pieces
    d = len(T[0]) - 1
    turn = np.zeros(3)
    turn[d - len(twist) :] = twist[d:]
    generator = np.zeros_like(T[0])
    generator[:d, :d] = np.cross(turn, np.eye(3)).T[:d, :d]
    generator[:d, d] = twist[:d]
    return np.repeat(vectors_of(linalg.expm(generator)[None]), pieces, axis=0)


def _motions(given: ArrayLike, noise: WhiteNoise) -> Array:
    """Motions (K, n) of poses (K, 3) or (K, 7), or of one."""
    values = np.atleast_2d(np.asarray(given, float))
    width = 3 if len(noise.axes) == 3 else 7
    if values.ndim != 2 or values.shape[1] != width or not np.isfinite(values).all():
        raise InputError(f"motion: needs {width} finite numbers a step, got an array of {np.shape(given)}")
    return vectors_of(matrices(values))


def _is_planar(drives: Sequence[Drive], axes: int | None) -> bool:
    if not drives or not all(isinstance(drive, Drive) for drive in drives):
        raise InputError("records: needs at least one drive, of cs.read_drives or cs.drive_of")
    if axes not in (None, 3, 6):
        raise InputError(f"--axes {axes}: must be 3 (x, y, yaw) or 6; a number here, names in 'analyse'")
    spaces = {drive.d for drive in drives}
    if len(spaces) > 1:
        raise InputError("drives in the plane and in space do not go together; give --axes 3 poses in the plane")
    if spaces == {2} and axes == 6:
        raise InputError("--axes 6: the poses are x, y, heading, which have 3")
    return spaces == {2} or axes == 3


def _judge_spans(
    folds: Sequence[Fold],
    windows: DriveWindows,
    general: bool,
) -> tuple[JudgedSpan, ...]:
    """Judge the fit at its span and at longer ones, as long as there are windows."""
    found = []
    for times in SPANS:
        some = windows if times == 1 else windows.over(windows.span.size * times)
        if some is None or sum(int(fold.judges(some).sum()) for fold in folds) < FEWEST:
            break
        found.append(judged_by(folds, some, general))
    if not found:
        raise InputError(
            f"--span {windows.span.option}: fewer than {FEWEST} windows are left to judge; take a shorter span or "
            f"longer drives: {DECIDE} windows, or {ENOUGH} drives, make a verdict possible"
        )
    return tuple(found)


def model_sentence(model: NoiseModel) -> str:
    """Span, status, ratio with its interval, and on how many drives it rests."""
    word = model.status
    if word == "consistent":
        word = f"consistent within x{DETECT:g}"
    judged, windows = model.ratio.drives, plural(model.ratio.windows, "window")
    basis = f"fitted on {plural(len(model.fitted_drives), 'drive')}, judged on {judged} ({windows})"
    if model.held_out == HALF:
        halves = "half" if judged == 1 else "halves"
        basis = f"fitted on the first {halves} of {plural(judged, 'drive')}, judged on the second ({windows})"
    elif model.held_out == IN_TURN:
        basis = f"{plural(judged, 'drive')}, each judged by the fit of the others ({windows})"
    parts = [f"at {_text(model.span)} {word}: held-out ratio {shown(model.ratio)}", basis, *_reasons(model)]
    return "; ".join(parts)


def _text(span: str) -> str:
    return span_of(span).text


def _reasons(model: NoiseModel) -> Iterator[str]:
    """Reasons for a status that the ratio does not tell."""
    ratio, at_span = model.ratio, model.spans[0]
    if model.held_out == HALF and model.status == "undecided":
        yield "halves of a drive show nothing about a new one; give drives that are not fitted"
    elif ratio.drives < ENOUGH and ratio.windows < DECIDE:
        yield f"too few to decide, which takes {ENOUGH} drives or {DECIDE} windows"
    if model.second is not None and model.second.is_shared.any():
        worst = int(np.argmax(model.second.correlation))
        yield (
            f"errors in {model.noise.axes[worst]} correlate {model.second.correlation[worst]:.2f} with those of the "
            "second estimator: they are the truth's, or the calibration's"
        )
    for each in model.lasting:
        if each.decides and at_span.status == "consistent":
            yield (
                f"{each.term} differs between drives and makes up {each.share:.0%} of the variance of an axis, so that "
                "new drives may have another covariance"
            )
    wrong, unknown = [], []
    for name, axis in zip(model.noise.axes, at_span.axes, strict=True):
        if axis.status in WRONG:
            wrong.append(f"{name} {axis.status}")
        elif axis.status == "undecided" and axis.drives:
            unknown.append(name)
    if wrong:
        yield ", ".join(wrong)
    if unknown and ratio.status == "consistent":
        yield f"undecided: {', '.join(unknown)}"
    if model.by_motion is not None and model.by_motion.is_found:
        yield dependence(model.by_motion, model.noise.mean.slip != 0.0)


def dependence(found: MotionDependence, is_corrected: bool) -> str:
    """A mean error that depends on the motion, and what to do about it."""
    unit, motions = ("rad", "turns") if found.by == "turn" else ("m", "ways")
    *values, last = (f"x{value:.3g}" for value in found.values)
    edges = (f"{edge:.2g} {unit}" for edge in found.edges)
    bins = [f"{value} for {motions} up to {edge}" for value, edge in zip(values, edges, strict=True)]
    offer = ""
    if (found.scale, found.by) == (TERMS[0], "turn") and not is_corrected:
        offer = "correct the way by the turn with --by-turn, or "
    return (
        f"{found.scale} depends on the {found.by}: {', '.join(bins)}, {last} beyond; that is {found.share:.0%} of the "
        f"variance of {found.axis}: {offer}state that spread in the covariance (add the square of {found.reach:.2g} "
        f"{_unit(found.axis)} to the variance of {found.axis})"
    )


def _unit(axis: str) -> str:
    return "m" if axis in "xyz" else "rad"


def noise_document(model: NoiseModel) -> Document:
    """Sentence, corrections, table over axes and spans, and limits; numbers as data."""
    numbers = [Column(head, number=True) for head in ("per m^.5", "per rad^.5", "at least")]
    first, *longer = (_text(each.span) for each in model.spans)
    columns = (Column("axis"), *numbers, Column(f"held-out {first}"), *map(Column, longer))
    rows: list[tuple[Cell, ...]] = []
    for i, axis in enumerate(model.noise.axes):
        variances = model.per_m[i].value, model.per_rad[i].value, model.noise.floor[i]
        sigmas = [f"{np.sqrt(value):.2g} {_unit(axis)}" for value in variances]
        rows.append((axis, *sigmas, *(_cell(each.axes[i]) for each in model.spans)))
    rows.append(("all", "", "", "", *(_cell(each.whole) for each in model.spans)))
    label = "Noise of each axis, and ratios of true to stated covariance over spans"
    opening: list[Block] = [Text(f"{model.name}: {model_sentence(model)}")]
    if corrected := correction(model):
        opening.append(Text(corrected))
    opening.append(table(columns, rows, label, style="plain"))
    opening += map(Text, noise_lines(model))
    return Document(
        f"{model.name}: noise of motions over {_text(model.span)}", "", (), tuple(opening), data_of_model(model)
    )


def correction(model: NoiseModel) -> str:
    """What is corrected before the covariance holds; empty where nothing is."""
    mean, fit = model.noise.mean, model.noise.mean_fit
    parts = []
    if mean.slip:
        parts.append(f"{mean.slip:+.3g} m of way a rad of turn")
    if fit is not None and fit.free.any():
        shown = [f"way x{mean.way:.4g}", f"turn x{mean.turn:.4g}"]
        shown += [f"{name} {each:+.3g} rad/m" for name, each in zip(_drifts(mean), mean.drift, strict=True)]
        parts.append(", ".join(np.array(shown)[fit.free]))
    return f"correct first: {', then '.join(parts)}" if parts else ""


def _drifts(mean: Mean) -> tuple[str, ...]:
    return ("heading",) if len(mean.drift) == 1 else ("roll", "pitch", "yaw")


def _of_mean(fit: MeanFit) -> Iterator[str]:
    """What is not corrected, and whether the scale of turns depends on whose noise it is."""
    names = ["way x", "turn x", *(f"{each} " for each in _drifts(fit.mean))]
    left = []
    for name, low, high, is_free in zip(names, fit.low, fit.high, fit.free, strict=True):
        if not is_free:
            left.append(f"{name}[{low:.3g}, {high:.3g}]")
    if left:
        yield f"not corrected, as the interval holds none: {', '.join(left)}"
    forward, backward = (f"x{short(each)}" for each in fit.turns)
    sides = f"{forward} if the robot's motion errs about the odometry, {backward} if the odometry errs about the motion"
    if fit.instruments == NEIGHBOURS:
        found = (
            f"the scale of turns is that by the motion of neighbouring windows (F {short(fit.strength)}), not {sides}"
        )
        if fit.turns[1] > fit.high[1]:
            found += "; the true side errs, too, as of slip, or of a truth that drifts or jitters: --second tells which"
        yield found
    elif fit.is_open:
        why = "neighbouring windows tell less than these"
        if fit.strength < STRONG:
            why = f"neighbouring windows are weak instruments (F {short(fit.strength)}, below {STRONG:g})"
        elif fit.lasts:
            why = "errors outlast a window, so that neighbouring windows are not instruments"
        yield f"whose noise it is cannot be told: the scale of turns is {sides}; {why}"


def _cell(ratio: Ratio) -> Cell:
    if not np.isfinite(ratio.low):
        return Quantity(ratio.value)
    return shown(ratio) + MARK[ratio.status]


def noise_lines(model: NoiseModel) -> Iterator[str]:
    """Limits of the model, what was left out, and what the referee says of the judged motions."""
    unshown = [each.span for each in model.spans[1:] if each.whole.status != "consistent"]
    limits = [f"not shown for {_text(unshown[0])} and more" if unshown else f"shown for {_text(model.span)} alone"]
    new_drive = "not known from one"
    if np.isfinite(model.ratio.spread):
        low, high = model.ratio.reach
        new_drive = f"{low:.2g} to {high:.2g}"
    limits += [f"a new drive: {new_drive}", f"jumps cut: {model.counts['jumps']}"]
    for key, why in (("still", "without motion"), ("long", "with rows or truth missing")):
        if number := model.counts[key]:
            limits.append(f"left out {why}: {number}")
    yield "; ".join(limits)
    if model.noise.factor != 1.0:
        yield f"cautious: all covariances are raised x{model.noise.factor:.3g}, so that a new drive rarely has more"
    if shift := model.drives[0].shift:
        yield (f"clocks: {shift:.3g} s are added to the timestamps of the estimates, for which the motions agree best")
    if model.second is not None:
        yield _of_second(model.second, model.noise.axes)
    if model.noise.mean_fit is not None:
        yield from _of_mean(model.noise.mean_fit)
    yield from model.warnings
    yield f"analyse counts each judged motion as a run, though those of a drive depend: {model.verdict.reasons[0]}"


def _of_second(second: SecondErrors, axes: Sequence[str]) -> str:
    shown = ", ".join(f"{axis} {each:.2f}" for axis, each in zip(axes, second.correlation, strict=True))
    found = f"correlation with errors of the second estimator: {shown}; above {SHARED:g} they are the truth's"
    if second.is_rough.any():
        found += f"; it errs too much to tell in {', '.join(np.array(axes)[second.is_rough])}"
    return found


def data_of_model(model: NoiseModel) -> dict[str, Any]:
    """Everything as plain data, as noise.toml and --json have it."""
    noise, mean, fit, second = model.noise, model.noise.mean, model.noise.mean_fit, model.second
    found: dict[str, Any] = plain({
        "name": model.name,
        "status": model.status,
        "sentence": model_sentence(model),
        "span": model.span,
        "axes": noise.axes,
        "fitted_drives": model.fitted_drives,
        "judged_drives": model.judged_drives,
        "held_out": model.held_out,
        "counts": model.counts,
        "mean": {
            "way": mean.way,
            "turn": mean.turn,
            "drift_rad_per_m": mean.drift,
            "slip_m_per_rad": mean.slip,
            **{key: getattr(fit, key) for key in EVIDENCE if fit is not None},
        },
        "noise": {
            "variance_per_m": noise.per_m,
            "variance_per_rad": noise.per_rad,
            "floor": noise.floor,
            "factor": noise.factor,
            "per_m_interval": model.per_m,
            "per_rad_interval": model.per_rad,
        },
        "by_motion": vars(model.by_motion) if model.by_motion is not None else None,
        "growth": model.growth.power,
        "warnings": model.warnings,
        "second_correlation": second.correlation if second is not None else None,
        "second_size": second.size if second is not None else None,
        "spans": [_data_of_span(each, noise.axes) for each in model.spans],
        "referee": model.verdict.statistics,
    })  # fmt: skip
    return found


def _data_of_span(span: JudgedSpan, axes: tuple[str, ...]) -> dict[str, Any]:
    found: dict[str, Any] = {"span": span.span}
    for name, ratio in zip(("whole", *axes), (span.whole, *span.axes), strict=True):
        found[name] = {key: getattr(ratio, key) for key in RATIO}
    found["by_drive"] = span.by_drive[:, 0]
    return found
