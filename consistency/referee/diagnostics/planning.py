"""How many runs a verdict needs.

There are looks at growing numbers of runs, a plan from a pilot, and the pieces of a single log. The formulas for one
fixed number of runs are in ``statistics.number_of_runs``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from consistency.referee.defaults import CONFIDENCE, DETECT, FALSE_ALARM, POWER
from consistency.referee.diagnostics import distributions
from consistency.referee.diagnostics.nees import FEW
from consistency.referee.diagnostics.number_of_runs import (
    FEWEST_PLANNED,
    gate_runs,
    lost_runs,
    require_rates,
    required_runs,
)
from consistency.referee.diagnostics.record import Record, numbered_axes
from consistency.referee.diagnostics.scale import LEAST, MeanTest, deciding_runs, run_means, scale_test
from consistency.referee.diagnostics.verdict_parts import BIAS, MAIN, SHARES, Interval, Settings, Within
from consistency.referee.diagnostics.whitening import mean_of_runs, squared_length, whiten
from consistency.referee.errors import InputError
from consistency.referee.types import Array

FIRST = 12  # runs at the first look; with fewer hardly anything but a failed run would be found
PARTS = 4  # times that the scale is looked at from one look to the next
MARGIN = 1.15  # on the runs of a pilot's plan, measured: it then keeps its power
REACH = 5.0  # correlation times over which autocorrelations are summed: Sokal (1997), sec. 3
LONG = 20.0  # correlation times that a log has at least; by simulation (benchmarks/single_log.py)
APART = 10.0  # correlation times in a piece of a log that stands as a run
MOST = 50  # pieces; more gain nothing


FEWEST = 20  # pieces
GROWTH = 2.0  # of a stated variance over the log, beyond which pieces are not alike, if it grows steadily
STEADY = 0.8  # rank correlation of a variance with the time, above which it grows steadily
CAPTION = "what is constant over the log is not judged, and every piece has it"


@dataclass(frozen=True)
class Design:
    """Plan of looks, with the share of the false-alarm rate of each.

    The scale is tested by an e-process, which is valid at any time. All other questions are asked at looks after 12,
    24, 48, ... runs; look j = 0, 1, ... has the share 1 / ((j + 1) (j + 2)) of their false-alarm rate. The shares add
    to 1 at most, however many looks there are (Bonferroni).
    """

    dof: int
    detect: float = DETECT
    false_alarm: float = FALSE_ALARM  # of all looks together
    power: float = POWER
    max_runs: int | None = None  # what is open then is undecided
    lost: float | None = None  # see :class:`Settings`

    def __post_init__(self) -> None:
        if self.max_runs is not None and self.max_runs < 1:
            raise ValueError(f"max_runs must be at least 1, got {self.max_runs}")
        if self.dof < 1:
            raise ValueError(f"dof must be at least 1, got {self.dof}")
        _ = self.settings

    @property
    def settings(self) -> Settings:
        """Settings of each look."""
        return Settings(self.false_alarm, self.detect, self.power, lost=self.lost)

    def inspections(self) -> Iterator[tuple[int, float | None]]:
        """Numbers of runs at which to look, and the share of each look; None where only the scale is tested."""
        runs = FIRST
        j = 0
        last = self.max_runs
        while True:
            spent = 1.0 / ((j + 1) * (j + 2))
            if last is not None and runs >= last:
                yield last, spent
                return
            yield runs, spent
            for part in range(1, PARTS):
                between = runs + runs * part // PARTS
                if last is not None and between >= last:
                    break
                yield between, None
            runs = 2 * runs
            j = j + 1


def sequential_design(
    dof: int,
    detect: float = DETECT,
    false_alarm: float = FALSE_ALARM,
    power: float = POWER,
    max_runs: int | None = None,
    lost: float | None = None,
) -> Design:
    """A :class:`Design`.

    Raises
    ------
    ValueError
        A value out of its range.
    """
    return Design(dof, detect, false_alarm, power, max_runs, lost)


@dataclass(frozen=True)
class PilotPlan:
    """Number of runs that a verdict needs, according to a pilot."""

    pilot_runs: int
    effective_dof: float  # of one run, one standard error to the safe side
    standard_error: float  # of its logarithm
    runs: int


def pilot_plan(
    means: Array,
    dof: int,
    steps: int,
    detect: float,
    false_alarm: float = FALSE_ALARM,
    power: float = POWER,
    allow: str | None = None,
    lost: float | None = None,
) -> PilotPlan:
    """Runs that :func:`judge` needs if steps depend on each other as in a pilot, and not completely.

    :func:`gate_runs` at the pilot's effective degrees of freedom, one standard error to the safe side, times 1.15: a
    verdict estimates them again from its own runs. At least 30 runs, since fewer miss too easily that the covariance
    is wrong in a few of them. Scale and bias of the pilot do not matter, only the spread of its run means.

    Parameters
    ----------
    means : (runs,), mean NEES of each run over ``dof``; at least 20
    steps : of a run
    lost : share of lost runs that is to be excluded

    Raises
    ------
    ValueError
        Fewer than 20 runs, or an argument that :func:`required_runs` or :func:`lost_runs` refuses.
    """
    require_rates(dof, false_alarm, power)
    if len(means) < FEW:
        raise ValueError(f"a pilot needs at least {FEW} runs, got {len(means)}")
    test = scale_test(means / means.mean(), dof, steps)
    share = SHARES[MAIN] * false_alarm
    least = required_runs(test.effective_dof, detect, share, power, two_sided=allow is None)
    runs = max(FEWEST_PLANNED, min(int(np.ceil(MARGIN * least)), gate_runs(dof, detect, false_alarm, power, allow)))
    if lost is not None:
        runs = max(runs, lost_runs(lost, power))
    return PilotPlan(len(means), test.effective_dof, float(np.sqrt(2.0 / test.spread)), runs)


def within(nees: Array, dof: int, settings: Settings, factor: float) -> Within | None:
    """Ratio of true to stated covariance of one log, with an interval from how its NEES decorrelates.

    The mean of T values Y_k = NEES_k / dof has the variance s^2 tau / T with the integrated autocorrelation time tau,
    summed over a window of at least 5 tau (Madras & Sokal 1988; Sokal 1997, "Monte Carlo methods in statistical
    mechanics", sec. 3). Its distribution is taken as chi-square(nu) / nu with nu = 2 T mean^2 / (s^2 tau), one standard
    error to the safe side, and Student's t for the remaining uncertainty. An error that is constant over the log is not
    detected.

    Parameters
    ----------
    nees : (T,), in order; NaN where there is none
    factor : by which the ratio may be off in a log that decides

    Returns
    -------
    None where the log has fewer than 20 correlation times
    """
    values = nees[np.isfinite(nees)] / dof
    if len(values) < LONG or not values.std() > 0:
        return None
    tau, reach = correlation_time(values - values.mean())
    steps = len(values)
    if steps < LONG * tau:
        return None
    ratio = float(values.mean())
    spread = float(values.var(ddof=1))
    fourth = float(np.mean((values - ratio) ** 4)) / spread**2
    doubt = 2.0 * (2.0 * reach + 1.0) / steps + max(fourth - 1.0, 0.0) * tau / steps  # variance of log(tau s^2)
    log_nu = np.log(2.0 * ratio**2 * steps / (spread * tau)) - np.sqrt(doubt)
    nu = float(np.exp(min(log_nu, np.log(dof * steps))))
    z = float(distributions.t.isf(0.5 * (1.0 - CONFIDENCE), max(2.0 / doubt, LEAST)))
    low = float(distributions.chi2.ppf(special.ndtr(-z), nu)) / nu
    high = float(distributions.chi2.ppf(special.ndtr(z), nu)) / nu
    interval = Interval(ratio, ratio / high, ratio / max(low, 1e-300))
    one_step = MeanTest(FEW, ratio, nu / steps, np.inf, np.nan, np.nan)
    least = deciding_runs(one_step, factor, settings)
    if least is None:
        return Within(interval, tau, nu, None, None)
    needed = max(int(np.ceil(MARGIN * least)), int(np.ceil(FEW * APART * tau)))
    return Within(interval, tau, nu, needed, int(min(MOST, max(needed, steps) // (APART * tau))))


def correlation_time(series: Array) -> tuple[float, int]:
    """Integrated correlation time of a series (T,) about zero, at least 1, and the lag up to which it was summed."""
    T = len(series)
    transform = np.fft.rfft(series, 2 * T)
    covariance = np.fft.irfft(transform * transform.conj(), 2 * T)[:T]
    if not covariance[0] > 0:
        return 1.0, 1
    tau = 2.0 * np.cumsum(covariance / covariance[0]) - 1.0
    window_reached = np.arange(T) >= REACH * tau
    lag = T - 1
    if window_reached.any():
        lag = int(np.argmax(window_reached))
    return max(1.0, float(tau[lag])), max(lag, 1)


# --- pieces that stand as runs -----------------------------------------------------------------------


@dataclass(frozen=True)
class ErrorMemory:
    """Over how many steps the errors of a log last."""

    steps: int  # of the log
    time: float  # integrated correlation time, steps: the larger of both
    upper: float  # end of its one-sided 95 % interval

    @property
    def piece(self) -> int:
        """Least number of steps in a piece."""
        if not np.isfinite(self.upper):
            return self.steps + 1
        return max(int(np.ceil(APART * self.upper)), 1)

    @property
    def pieces(self) -> int:
        """Advised number of pieces; it does not depend on the size of the errors."""
        return min(int(self.steps // self.piece), int(MOST))


def memory_of(whitened: Array) -> ErrorMemory:
    """Integrated correlation time of the errors of a log about zero, and of their squares about their mean.

    A constant error never decorrelates about zero; about the log's own mean it would not be seen. The largest time of
    all components and of the NEES counts. Autocorrelations are summed over a window of 5 times (Sokal 1997, sec. 3);
    the variance of the time is 2 (2 window + 1) / steps of its square (Madras & Sokal 1988).

    Parameters
    ----------
    whitened : (T, n), L^-1 e with L L' = P; NaN where there is none
    """
    w = whitened[np.isfinite(whitened).all(axis=1)]
    if len(w) < 2:
        return ErrorMemory(len(whitened), np.inf, np.inf)
    nees = np.square(w).sum(axis=1)
    longest = 0.0
    upper = 0.0
    z = float(special.ndtri(CONFIDENCE))
    for series in (*w.T, nees - nees.mean()):
        time, reach = correlation_time(series)
        longest = max(longest, time)
        upper = max(upper, time * float(np.exp(z * np.sqrt(2.0 * (2.0 * reach + 1.0) / len(w)))))
    return ErrorMemory(len(whitened), longest, upper)


def in_pieces(record: Record, count: int | None = None) -> Record:
    """The record of one log with its pieces as runs.

    Nothing is shown (``Record.unshown``) by fewer than 20 pieces, by pieces of fewer than 10 correlation times, or
    where neighbours do not seem to be independent (:func:`independence.independence` of their mean errors and mean
    NEES). A bias is not asked: one log does not tell an error that is constant from one that changes slowly.

    Parameters
    ----------
    count : number of pieces; None takes the advised one, which depends on correlations alone

    Raises
    ------
    InputError
        There is more than one run, no error, or a stated variance grows over the log.
    """
    if record.errors.error is None or record.errors.covariance is None or len(record.errors.error) != 1:
        raise InputError(f"--split: needs the errors of one log; {record.name} has {len(record.run_numbers)} runs")
    if record.failures:
        raise InputError(f"--split: {record.name} failed in step {record.failures[0].step}; cut the log before that")
    P = np.asarray(record.errors.covariance, float)
    whitened = whiten(record.errors.error, P)[0]
    whitened_steps = np.flatnonzero(np.isfinite(whitened).all(axis=1))
    if not len(whitened_steps):
        raise InputError(f"--split: {record.name} has no step that can be judged")
    log = slice(int(whitened_steps[0]), int(whitened_steps[-1]) + 1)
    _require_steady(record, P[0, log])
    memory = memory_of(whitened[log])
    pieces = count
    if pieces is None:
        pieces = max(memory.pieces, FEWEST)
    length = memory.steps // max(pieces, 1)
    if length < 1:
        raise InputError(f"--split {pieces}: {record.name} has only {memory.steps} steps")
    end = log.start + pieces * length
    whitened_pieces = whitened[log.start : end].reshape(pieces, length, -1)
    clock = record.runs.t
    times = None
    if record.runs.times is not None:
        clock = record.runs.times[0]
    if len(clock):
        times = clock[log.start : end].reshape(pieces, length)
    note = (
        f"{record.name}: the log is cut into {pieces} pieces of {length} steps, treated as runs; its errors last "
        f"over {memory.time:.3g} steps"
    )
    runs = replace(record.runs, times=None)
    of_pieces = replace(record, runs=runs, truth=replace(record.truth, covariance=None)).changed(
        lambda array: array[0, log.start : end].reshape(pieces, length, *array.shape[2:])
    )
    return replace(
        of_pieces,
        runs=replace(
            of_pieces.runs, numbers=np.arange(1, pieces + 1), unit="piece", times=times, t=np.full(length, np.nan)
        ),
        truth=record.truth,
        fit=replace(record.fit, caption=CAPTION, unavailable=BIAS),
        origin=replace(of_pieces.origin, unshown=_unshown(memory, pieces, length, whitened_pieces)),
    ).with_notes(note)


def _require_steady(record: Record, P: Array) -> None:
    """Refuse a log whose stated variances (T, n, n) grow: its errors have no size that pieces share."""
    blocks = np.array_split(np.diagonal(P, axis1=1, axis2=2), FEWEST)
    if min(map(len, blocks)) == 0:
        return
    medians = np.array([np.nanmedian(block, axis=0) for block in blocks])
    names = record.errors.names or numbered_axes(medians.shape[1])
    for axis, values in zip(names, medians.T, strict=True):
        ratio = float(values[-1] / max(values[1], np.finfo(float).tiny))
        signs = np.sign(values[None, :] - values[:, None])[np.triu_indices(len(values), 1)]
        if ratio > GROWTH and signs.mean() > STEADY:  # rank correlation with the order (Kendall 1938)
            raise InputError(
                f"--split: the stated variance of {axis} grows by x{ratio:.3g} over the log, so that its pieces are "
                "not alike; judge motions over windows: --relative 10s"
            )


def _unshown(memory: ErrorMemory, pieces: int, length: int, parts: Array) -> str:
    """Why nothing is shown by these pieces; '' where it may be."""
    if pieces < FEWEST:
        return f"{pieces} pieces of one log are too few, at least {FEWEST} are needed to see that they are independent"
    if length < memory.piece:
        whole = f"{memory.piece} steps"
        if memory.piece > memory.steps:
            whole = "as long as the log"
        return (
            f"{pieces} pieces of {length} steps are not shown to be independent: errors last over {memory.time:.3g} "
            f"steps (up to {memory.upper:.3g}), about zero or in size, and pieces should be {whole}"
        )
    from consistency.referee.diagnostics.whiteness import independence

    if independence(mean_of_runs(parts), run_means(squared_length(parts))[0]).doubtful:
        return f"{pieces} pieces of {length} steps do not seem to be independent"
    return ""
