"""The noise model of an odometry at one span: fitted, judged, and told in sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg, stats

from consistency.referee.diagnostics.judge_record import judge
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.diagnostics.verdict.verdict import Verdict
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
)
from consistency.referee.fit_covariance.drives import Drive
from consistency.referee.fit_covariance.mean_differences import (
    MotionDependence,
    PersistentError,
    mean_by_motion,
    persistent_errors,
)
from consistency.referee.fit_covariance.motion_windows import (
    ENOUGH,
    PIECES,
    DriveWindows,
    cut_windows,
    matrices_of,
    span_of,
    vectors_of,
)
from consistency.referee.fit_covariance.motions import record_of_motions, stretches_of
from consistency.referee.fit_covariance.refusals import (
    RotationGrowth,
    doubts,
    require_poses,
    require_sound,
    rotation_growth,
)
from consistency.referee.fit_covariance.second_estimator import SecondErrors, errors_of_second
from consistency.referee.fit_covariance.white_noise import WhiteNoise, fit_noise, jitter_of, variance_intervals
from consistency.referee.geometry.lie_groups import log, matrices
from consistency.referee.readers.truth_matching import Poses
from consistency.referee.types import Array

SPANS = (1, 2, 5, 10, 20)  # multiples of the span that the fit is judged at
FEWEST = 3  # windows at a span that is shown


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
        return matrices_of(self.noise.mean.corrected(_motions(motions, self.noise)))

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
            steps = evenly(steps[0], PIECES)
        return np.asarray(self.noise.covariance(steps[None])[0])

    def plot(self, path: str | Path | None = None) -> Any:
        """Errors with ellipses, growth of the squared error over spans, and ratios by drive; needs ``[plot]``.

        Parameters
        ----------
        path : .png, .pdf or .svg to write as well; one that is there is replaced
        """
        from consistency.referee.fit_covariance.page import draw_noise
        from consistency.referee.pages.write_pages import plotted

        return plotted(partial(draw_noise, self), path)

    def __repr__(self) -> str:
        from consistency.referee.fit_covariance.model_text import model_sentence  # of this class

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


def evenly(motion: Array, pieces: int) -> Array:
    """Divide a motion (n,) into equal pieces of one screw, (pieces, n)."""
    T = matrices_of(motion[None])
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


def error_windows(model: NoiseModel, judged: JudgedSpan) -> DriveWindows:
    """The windows of a span, corrected."""
    found = model.windows.over(span_of(judged.span).size)
    assert found is not None
    return model.noise.mean.applied(found)
