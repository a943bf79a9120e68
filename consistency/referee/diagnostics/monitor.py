"""Sequential test of the NIS for a deployed filter, with what a validation gate lets pass.

What a gate lets pass has a truncated chi-square distribution. Some filters log ratios to the gate in place of
variances. Those are not the NIS: how large the stated variance is cannot be told from them, and neither can a fault.
What can be told is how often a filter whose variances are right exceeds a ratio at most.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import special
from scipy.optimize import brentq

from consistency.referee.defaults import FALSE_ALARM, GATE_FALSE_ALARM, NIS_TOLERANCE
from consistency.referee.diagnostics import distributions
from consistency.referee.types import Array

RATIOS = (1.1, 1.25, 1.5, 2.0, 4.0)  # of an alternative to the edge of the tolerance
SERIES = 2.10975  # rounded up from 2.109743, the sum of 1 / (n ln^2 n) over n >= 2: the shares add up to less than 1
RESTS = ((0.99, 2), (0.95, 5))  # share that the gate accepts, at least; innovations not judged after a rejection
FAR = 1e-6  # probability that an innovation of a right filter is as large as an outlier
LARGEST = 1e300  # evidence is cut off here, which is on the safe side
EXPONENT = 690.0  # exp() of it is just below LARGEST
CAVEAT = (
    "Only the NIS is judged, under a gain declared optimal; "
    "neither the direction of an alarm nor silence says anything about the pose"
)
RARE = 0.05  # share of the innovations of a right filter that is called unusual
TINY = 1e-290  # below, a distribution function is taken from its series
WIDEST = 1e3  # scale up to which one is looked for
DISTANT = 1e3  # noncentral chi-square, beyond which its median is taken from its series


class _Reset(NamedTuple):
    """The last reset of a CUSUM, and the sums up to there."""

    step: int  # the one after it
    nis: float
    dof: int
    innovations: int
    rest_nis: float  # without outliers
    rest_dof: int


START = _Reset(1, 0.0, 0, 0, 0.0, 0)


@dataclass(frozen=True)
class Alarm:
    """The NIS of a filter is not what the filter states; ``print`` shows it as a sentence.

    Only the NIS is judged, of a filter whose gain was declared optimal. Neither the direction of an alarm nor
    silence says anything about the pose: on the drive KITTI 07 NIS / dof is 0.60, which looks conservative, while
    NEES / dof of the pose is 2.35, which is overconfident.
    """

    step: int  # in which it was raised, counted from 1 by calls of ``update``
    since: int  # first step of the fault, estimated: the last reset of the CUSUM of the best alternative
    direction: str  # overconfident: the NIS is too large | conservative: too small
    evidence: float  # e-value
    scale: float  # of the NIS since then: innovation covariance over the stated one; inf if a gate hides how much
    false_alarm: float
    tolerance: float
    outlier: int | None = None  # step of the last NIS since then that is an outlier
    rest: float = math.nan  # beside an outlier, NIS over degrees of freedom of the others: since then, or before

    def __str__(self) -> str:
        size = f"x{self.scale:.3g}"
        if math.isinf(self.scale):
            size = "larger than a gate lets see"
        what = f"{self.direction} since step {self.since}; scale of the NIS since then {size}"
        others = ""
        if self.outlier is not None:
            which = "this step" if self.outlier == self.step else f"step {self.outlier}"
            rest = f"that of the others x{self.rest:.3g}"
            if math.isnan(self.rest):
                rest = "nothing is known of others yet"
            others = f"; the NIS of {which} is an outlier, and {rest}"
            if not self.rest > self.tolerance:
                what = f"scale of the NIS since step {self.since} {size}"
        return (
            f"alarm in step {self.step}: {what} ({accepted_scales(self.tolerance)}){others}, e-value "
            f"{self.evidence:.3g} (alarm at {1 / self.false_alarm:.4g}). {CAVEAT}."
        )


def accepted_scales(tolerance: float) -> str:
    """The scales that are not fault, in words."""
    if tolerance == 1.0:
        return "x1 is right"
    return f"x{1 / tolerance:.3g} to x{tolerance:.3g} is accepted"


class Bet(NamedTuple):
    """Log-likelihood ratios of the alternatives for a number of degrees of freedom: constant + slope x NIS."""

    limit: float  # a NIS above is rejected by the gate
    far: float  # a NIS above is an outlier
    terms: tuple[tuple[float, float], ...]  # constant and slope of each alternative


def alternatives(tolerance: float) -> tuple[tuple[float, float], ...]:
    """Scales of the NIS above the tolerance, then as many below, each with the edge that it is set against."""
    above = [(tolerance * ratio, tolerance) for ratio in RATIOS]
    return (*above, *((1.0 / scale, 1.0 / edge) for scale, edge in above))


def bet_on(dof: int, tolerance: float = NIS_TOLERANCE, gate: float | None = None) -> Bet:
    """Bet for an innovation of ``dof`` degrees of freedom; see :class:`Monitor` for the formula."""
    limit = math.inf
    terms: list[tuple[float, float]] = []
    if gate is not None:
        limit = gate_limit(gate, dof)
    for scale, edge in alternatives(tolerance):
        constant = -0.5 * dof * math.log(scale / edge)
        if gate is not None:
            constant += log_chi2_cdf(limit / edge, dof) - log_chi2_cdf(limit / scale, dof)
        terms.append((constant, 0.5 * (1.0 / edge - 1.0 / scale)))
    return Bet(limit, gate_limit(1.0 - FAR, dof), tuple(terms))


def start_share(number: int, mission: int | None = None) -> float:
    """Share of the evidence that is put on a fault that begins with innovation 1, 2, ...; all shares add up to 1."""
    if mission is None:
        return 1.0 / (SERIES * (number + 1) * math.log(number + 1) ** 2)
    return (0.5 * (number == 1) + 0.5 / mission) * (number <= mission)


def rest_after_rejection(gate: float | None) -> int:
    """Accepted innovations that are not judged after a rejection.

    Raises
    ------
    ValueError
        The gate is not a probability in [0.95, 1).
    """
    if gate is None:
        return 0
    for share, rest in RESTS:
        if share <= gate < 1.0:
            return rest
    raise ValueError(
        f"gate must be a probability of at least {RESTS[-1][0]} and below 1, got {gate}; a gate that rejects more of "
        "what is right makes the filter's own covariance wrong"
    )


class Monitor:
    """Watch the NIS of a deployed filter; an alarm is false with probability at most ``false_alarm``, ever.

    The filter must have the optimal (Kalman) gain for its model: only then are the innovations of a right filter
    white. What is tested is that the covariance of the innovations is between 1 / ``tolerance`` and ``tolerance``
    times the stated one, in every step. One may look after each step and stop at any time. The NIS alone is judged:
    neither the direction of an alarm nor silence says anything about the pose.

    Parameters
    ----------
    false_alarm : probability that a right filter ever raises an alarm, however long the mission
    tolerance : 1 or more; 1 is the exact test, which in time alarms on every filter that is not exactly right
    gate : probability at which the filter's chi-square gate accepts the innovation of a right filter, such as 0.99;
        None without a gate. A NIS above its limit counts as rejected. Rejections are not evidence, and after one the
        next 2 innovations (5 with a gate below 0.99) are not judged; so a fault so large that the gate rejects nearly
        everything goes unseen here: look at ``rejections`` as well
    mission : number of innovations after which no fault begins, if known: an early fault is then found a little
        later, a late one sooner. The false-alarm rate holds beyond it too

    Attributes
    ----------
    steps : calls of ``update``
    measurements : those among them with a measurement
    rejections : measurements that the gate rejected
    refused : rejections with which the gate is judged: not those within so many innovations of another
    innovations : those that were judged
    evidence : e-value now; starts at 1
    largest : the largest so far; a right filter ever has 1 / a with probability at most a
    alarm : the first alarm, kept until ``reset``; None without

    Raises
    ------
    ValueError
        An argument out of its range.

    Notes
    -----
    Given the past, the NIS x of a step with d degrees of freedom is s chi-square(d), s the scale. With an alternative
    r beyond the edge a of the tolerance (r > a = tolerance, or r < a = 1 / tolerance), and F the distribution function
    of chi-square(d), the likelihood ratio of a NIS accepted by a gate with limit g is

        log LR_r(x) = -d/2 log(r / a) + x/2 (1/a - 1/r) + log F(g / a) - log F(g / r),

    without the last two terms if there is no gate. For r > a it increases in x, and x is stochastically increasing in
    s (cut at g or not, the family has a monotone likelihood ratio); so E_s LR_r <= E_a LR_r = 1 for every s <= a. For
    r < a likewise, for s >= a. With the shares p_t >= 0 of :func:`start_share`, which add up to at most 1,

        R_{r,t} = LR_r(x_t) (R_{r,t-1} + p_t),    E_t = mean over r of R_{r,t} + 1 - (p_1 + ... + p_t),

    E is nonnegative, E_0 = 1, and its expectation given the past never exceeds its present value: at most a share
    ``false_alarm`` of right filters ever reaches 1 / ``false_alarm`` (Ville 1939), even if s moves about within the
    tolerance. R is the statistic of Shiryaev (1963) and Roberts (1966) with a weight on each start, an e-detector
    (Shin, Ramdas & Rinaldo 2024); ``Alarm.since`` is the last reset of Page's (1954) CUSUM of the r with the largest R.

    A rejection leaves the error of the filter not quite Gaussian for a few steps. That not judging 2 (5) innovations
    is enough is measured, not proved: docs/monitor.md.
    """

    def __init__(
        self,
        false_alarm: float = GATE_FALSE_ALARM,
        tolerance: float = NIS_TOLERANCE,
        gate: float | None = None,
        mission: int | None = None,
    ) -> None:
        if not 0.0 < false_alarm < 1.0:
            raise ValueError(f"false_alarm must lie between 0 and 1, got {false_alarm}")
        if not 1.0 <= tolerance < math.inf:
            raise ValueError(f"tolerance must be 1 or more, got {tolerance}")
        if mission is not None and not (1 <= mission < math.inf and mission == int(mission)):
            raise ValueError(f"mission must be a whole number of 1 or more, got {mission}")
        self.false_alarm = false_alarm
        self.tolerance = tolerance
        self.gate = gate
        self.mission = mission
        self._rest = rest_after_rejection(gate)
        self._bets: dict[int, Bet] = {}
        self.reset()

    def reset(self) -> None:
        """Restart, as after construction: the next alarm is false with probability ``false_alarm`` again."""
        count = 2 * len(RATIOS)
        self.steps = self.measurements = self.rejections = self.innovations = self.refused = 0
        self.evidence = self.largest = 1.0
        self.alarm: Alarm | None = None
        self._nis = self._rest_nis = 0.0
        self._dof = self._rest_dof = 0
        self._outlier = 0  # the step of the last one
        self._fault = START  # the reset from which the alarm counts
        self._unspent = 1.0  # 1 - (p_1 + ... + p_t)
        self._skip = 0  # accepted innovations still not to be judged
        self._R = [0.0] * count
        self._cusum = [0.0] * count
        self._resets = [START] * count

    def update(self, nis: float | None, dof: int) -> Alarm | None:
        """Process the NIS of a step; return the alarm in the step that raises it, otherwise None.

        The alarm is returned once and stays in ``alarm``; the evidence is still updated. Takes microseconds.

        Parameters
        ----------
        nis : innovation' S^-1 innovation; None or NaN if there is none. With ``dof`` of 1 or more and a gate, that is
            a rejected measurement. Masked (``numpy.ma``) in a step without a measurement
        dof : dimension of the innovation; 0 in a step without a measurement

        Raises
        ------
        ValueError
            ``nis`` is negative or infinite, or ``dof`` not a whole number of 0 or more; nothing is counted then.
        """
        if isinstance(nis, np.ma.core.MaskedConstant):
            nis = None
            dof = 0
        if not (0 <= dof < math.inf and dof == int(dof)):
            raise ValueError(f"dof must be a whole number of 0 or more, got {dof}")
        value = math.nan
        if nis is not None:
            value = float(nis)
        if value < 0.0 or value == math.inf:
            raise ValueError(f"nis must be 0 or more and finite, got {nis}; the filter that gave it has failed")
        self.steps += 1
        if dof == 0:
            return None
        bet = self._bets.get(dof)
        if bet is None:
            bet = self._bets[dof] = bet_on(int(dof), self.tolerance, self.gate)
        rejected = not value <= bet.limit  # above it, or NaN
        if rejected and self.gate is None:
            return None
        self.measurements += 1
        if rejected:
            self.rejections += 1
            self.refused += not self._skip
            self._skip = self._rest
            return None
        if self._skip:
            self._skip -= 1
            return None
        self._judge(value, int(dof), bet)
        if self.alarm is not None or self.evidence < self.threshold:
            return None
        best = max(range(len(self._R)), key=self._R.__getitem__)
        reset = self._fault = self._resets[best]
        direction = "conservative"
        outlier = None
        rest = math.nan
        if best < len(RATIOS):
            direction = "overconfident"
            all_are = self._rest_dof == reset.rest_dof and self.innovations > reset.innovations + 1
            if self._outlier >= reset.step and not all_are:
                outlier = self._outlier
                rest = self.rest
        self.alarm = Alarm(
            self.steps, reset.step, direction, self.evidence, self._scale_since(reset), self.false_alarm,
            self.tolerance, outlier, rest,
        )  # fmt: skip
        return self.alarm

    @property
    def threshold(self) -> float:
        """The e-value of an alarm, 1 / ``false_alarm``."""
        return 1.0 / self.false_alarm

    @property
    def tried(self) -> int:
        """Measurements with which the gate is judged: those that would be judged where it accepts them."""
        return self.innovations + self.refused

    @property
    def gate_share(self) -> GateShare | None:
        """What the rejections say of the gate, at a number of steps that they did not choose; None without a gate."""
        if self.gate is None or not self.tried:
            return None
        return gate_share(self.refused, self.tried, self.gate)

    @property
    def smallest_spikes(self) -> dict[int, tuple[float, float]]:
        """By dimension of the innovation, :func:`smallest_spike` at the scale found, and at the scale 1."""
        if self.gate is None:
            return {}
        scale = self.scale if self._dof else 1.0
        return {
            dof: (smallest_spike(dof, self.gate, scale), smallest_spike(dof, self.gate)) for dof in sorted(self._bets)
        }

    @property
    def ratio(self) -> float:
        """Total NIS over total degrees of freedom of the innovations that were judged; NaN before the first."""
        if not self._dof:
            return math.nan
        return self._nis / self._dof

    @property
    def rest(self) -> float:
        """:attr:`ratio` without outliers, since the fault of the alarm; of all where no others are there since.

        NaN without any. Innovations after the alarm count as well.
        """
        if not self._rest_dof:
            return math.nan
        reset = self._fault
        if self._rest_dof == reset.rest_dof:
            reset = START
        return (self._rest_nis - reset.rest_nis) / (self._rest_dof - reset.rest_dof)

    @property
    def scale(self) -> float:
        """Scale of the NIS over all that was judged: ``ratio``, corrected for what the gate cuts off."""
        if not self._dof:
            return math.nan
        return self._scale_since(START)

    def _judge(self, nis: float, dof: int, bet: Bet) -> None:
        self.innovations += 1
        self._nis += nis
        self._dof += dof
        if nis > bet.far:
            self._outlier = self.steps
        else:
            self._rest_nis += nis
            self._rest_dof += dof
        share = start_share(self.innovations, self.mission)
        self._unspent = max(self._unspent - share, 0.0)
        R = self._R
        cusum = self._cusum
        here = _Reset(self.steps + 1, self._nis, self._dof, self.innovations, self._rest_nis, self._rest_dof)
        total = 0.0
        for i, (constant, slope) in enumerate(bet.terms):
            log_ratio = constant + slope * nis
            R[i] = min(math.exp(min(log_ratio, EXPONENT)) * (R[i] + share), LARGEST)
            total += R[i]
            cusum[i] += log_ratio
            if cusum[i] <= 0.0:
                cusum[i] = 0.0
                self._resets[i] = here
        self.evidence = total / len(R) + self._unspent
        self.largest = max(self.largest, self.evidence)

    def _scale_since(self, reset: _Reset) -> float:
        count = self.innovations - reset.innovations
        return gated_scale((self._nis - reset.nis) / count, (self._dof - reset.dof) / count, self.gate)


class GateShare(NamedTuple):
    """The rejections of a gate beside those of a right filter."""

    few: float  # p value that a right filter has as few, or fewer
    many: float  # as many, or more
    fewest: int  # measurements, of which none rejected shows that there are too few

    @property
    def finding(self) -> str:
        """Whether there are "too few" or "too many" at half of ``FALSE_ALARM`` each; "" where neither is shown."""
        if self.few <= 0.5 * FALSE_ALARM:
            return "too few"
        return "too many" if self.many <= 0.5 * FALSE_ALARM else ""


def gate_share(refused: int, tried: int, gate: float) -> GateShare:
    """Judge a gate that ``refused`` some of the ``tried`` measurements, of which it should reject 1 - ``gate``.

    In each step, given those before, a right filter rejects with that probability, and one whose innovation covariance
    is too large with less: whatever the steps have to do with each other, the number of rejections is stochastically at
    most binomial. Of all bets for a number of steps that is fixed before, the binomial test wins most often (Neyman &
    Pearson 1933). Right after a rejection the error of a right filter is larger, and steps are not tried; that this
    keeps the rate of "too many" is measured, not proved (docs/reference/rates.md).
    """
    few = float(special.bdtr(refused, tried, 1.0 - gate))
    many = float(special.bdtrc(refused - 1, tried, 1.0 - gate)) if refused else 1.0
    return GateShare(few, many, math.ceil(math.log(0.5 * FALSE_ALARM) / math.log(gate)))


def smallest_spike(dof: int, gate: float, scale: float = 1.0) -> float:
    """The smallest spike that a gate rejects with probability 50 %, in true standard deviations of the innovation.

    Its length sqrt(d' S^-1 d) by the true covariance S of the innovation, which is ``scale`` times the stated one. The
    square is the noncentrality at which the noncentral chi-square has its median at the limit over the scale; far out
    that is the limit less dof - 1. 0 where half of all innovations are rejected without a spike.
    """
    limit = gate_limit(gate, dof) / scale
    if limit > DISTANT:
        return math.sqrt(limit - dof + 1.0)
    if special.gammainc(0.5 * dof, 0.5 * limit) <= 0.5:
        return 0.0
    return math.sqrt(float(special.chndtrinc(limit, dof, 0.5)))


@dataclass(frozen=True)
class GateRatios:
    """Ratios of one sensor over time."""

    sensor: str
    t: Array  # (N,), s, not decreasing
    ratio: Array  # (N,), |innovation| / (gate sigma); rejected above 1
    gate: float  # sigma; NaN where it is not known
    components: int  # at most, of which the ratio is the largest or the root of a mean

    @property
    def unusual(self) -> float:
        """The ratio that a right filter exceeds in at most ``RARE`` of its innovations; NaN without the gate.

        By Bonferroni's bound over the components, sqrt(2) erfcinv(RARE / components) sigma. It also holds for the root
        of sum e^2 / sum S: of all weights, all on one component gives the heaviest tail (Szekely & Bakirov 2003,
        "Extremal probabilities for Gaussian quadratic forms").
        """
        return float(np.sqrt(2.0) * special.erfcinv(RARE / self.components) / self.gate)

    @property
    def rejected(self) -> float:
        """The share above 1 that a right filter has at most; NaN without the gate."""
        return float(np.minimum(1.0, self.components * special.erfc(self.gate / np.sqrt(2.0))))

    def above(self, limit: float) -> float:
        """Share of the ratios above a limit; NaN where the limit is."""
        return float("nan") if np.isnan(limit) else float(np.mean(self.ratio > limit))

    def over_time(self, limit: float, pieces: int = 10) -> tuple[Array, Array]:
        """Beginnings, s, of equal pieces of time, and the share above a limit in each, NaN where it is empty."""
        edges = np.linspace(self.t[0], self.t[-1], pieces + 1)
        piece = np.clip(np.searchsorted(edges, self.t, side="right") - 1, 0, pieces - 1)
        count = np.bincount(piece, minlength=pieces)
        over = np.bincount(piece, self.ratio > limit, minlength=pieces)
        share = np.where((count > 0) & ~np.isnan(limit), over / np.maximum(count, 1), np.nan)
        return edges[:-1], share


def gate_limit(gate: float, dof: float) -> float:
    """Largest accepted NIS of a gate that accepts the share ``gate`` of the innovations of a right filter."""
    return float(distributions.chi2.ppf(gate, dof))


def log_chi2_cdf(x: float, dof: float) -> float:
    """Logarithm of the chi-square distribution function, without underflow.

    Far below the mean from its series, NIST Digital Library of Mathematical Functions eq. 8.7.1 and 8.5.1.
    """
    value = float(special.gammainc(dof / 2, x / 2))
    if value > TINY:
        return math.log(value)
    a = dof / 2
    half = x / 2
    series = float(special.hyp1f1(1.0, a + 1.0, half))
    return a * math.log(half) - half - math.lgamma(a + 1.0) + math.log(series)


def gated_mean(scale: float, dof: float, limit: float) -> float:
    """Mean of scale times chi-square(dof), given that it is at most ``limit``."""
    x = limit / scale
    return scale * dof * math.exp(log_chi2_cdf(x, dof + 2) - log_chi2_cdf(x, dof))


def gated_scale(mean: float, dof: float, gate: float | None) -> float:
    """The scale at which the mean NIS behind the gate is ``mean``: its maximum-likelihood estimate.

    ``dof`` may be an average. Infinite where the mean is larger than that of any scale up to 1,000: the values then
    show only that they were accepted.
    """
    if gate is None or mean == 0.0:
        return mean / dof
    limit = gate_limit(gate, dof)
    low, high = 0.5 * mean / dof, WIDEST  # behind a gate the mean is never above scale times dof
    if gated_mean(high, dof, limit) <= mean:
        return math.inf
    return float(brentq(lambda scale: gated_mean(scale, dof, limit) - mean, low, high, rtol=1e-9))
