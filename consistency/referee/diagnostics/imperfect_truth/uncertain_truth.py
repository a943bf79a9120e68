"""Truth with a covariance of its own: errors d = e + v of estimate and truth, of which P alone is judged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy import optimize

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.questions.bias import hotelling, t_squared
from consistency.referee.diagnostics.questions.equivalence import equivalence, equivalent
from consistency.referee.diagnostics.questions.scale import scale_test
from consistency.referee.diagnostics.questions.shape import weighted_chi_square_tail
from consistency.referee.diagnostics.questions.sample import Sample, sample_of
from consistency.referee.diagnostics.records.whitening import mean_of_runs
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.diagnostics.verdict.answers import AXIS, BIAS, MAIN, SHARES, least
from consistency.referee.diagnostics.judging.fault_location import accuracy_of, bias_of
from consistency.referee.diagnostics.verdict.parts import Equivalence, Interval, Settings, TruthShare, Verdict
from consistency.referee.diagnostics.judging.status import at_share
from consistency.referee.types import Array

if TYPE_CHECKING:
    from consistency.referee.diagnostics.records.record import Record

DECLARED = ("independent", "per-run", "common")  # how errors of the truth depend on each other
MOST = 0.5  # share of the truth in both covariances beyond which nothing is decided
SHARED = 2.0  # (e + v)(e + v)' is at most twice ee' + vv', however e and v depend on each other


@dataclass(frozen=True)
class UncertainTruth:
    """What is asked of errors d = e + v, with e of covariance P if the filter is right, and v of the stated P_t.

    With S = P + P_t and the share s = tr(S^-1 P_t) / n the mean NEES of d by S, over n, is r = k (1 - s) + s if e has
    the covariance k P: the ratio that is reported is k = (r - s) / (1 - s).

    - ``independent`` and ``per-run``: errors of different runs are independent, so every question is asked of S.
    - ``common``: v is the same in all runs, and contrasts between runs do not have it. Every question but that of a
      bias is asked of them and P.
    - not declared: v may depend on itself in any way, over steps and runs. A covariance that is too large is found by
      P alone, as adding v makes no symmetric convex set more likely (Anderson 1955). A bias is found beyond
      mean P / N + mean P_t, as the covariance of a mean is at most the mean of the covariances. A covariance that is
      too small is found by S and :func:`upper_weights`. The other questions are not asked.
    - ``shared`` with the estimator: e and v depend on each other in any way, too. Then dd' is at most 2 (ee' + vv') in
      the mean, and no covariance is too large.
    """

    record: Record  # errors d, covariances P, and those of the truth

    @property
    def bounded(self) -> bool:
        """Whether only what holds under any dependence can be said."""
        r = self.record
        return r.truth_shared or r.truth_errors is None or (r.truth_errors == "common" and len(r.run_numbers) < 2)

    @property
    def _together(self) -> float:
        """Factor by which both covariances grow if e and v may depend on each other."""
        return SHARED if self.record.truth_shared else 1.0

    @property
    def contrasted(self) -> bool:
        return self.record.truth_errors == "common" and not self.bounded

    @cached_property
    def P(self) -> Array:
        return np.asarray(self.record.covariance, float)

    @cached_property
    def P_t(self) -> Array:
        assert self.record.truth_covariance is not None
        return np.asarray(self.record.truth_covariance, float)

    @cached_property
    def both(self) -> Record:
        """The record with the covariances of estimate and truth together."""
        return replace(self.record, covariance=self.P + self.P_t, truth_covariance=None)

    @cached_property
    def evidence(self) -> Record:
        """The record of which questions are asked."""
        if not self.contrasted:
            return self.both
        assert self.record.error is not None
        counted: Array = self.total.counted
        error, P = contrasts(np.where(counted[..., None], self.record.error, np.nan), self.P)
        return replace(self.both, error=error, covariance=P, nees=None)

    @cached_property
    def total(self) -> Sample:
        """Of d and S, whatever is judged."""
        sample = sample_of(self.both, Settings())
        assert sample is not None
        return sample

    # --- shares -----------------------------------------------------------------------------------

    def eigenvalues(self, index: list[int]) -> Array:
        """Those of S^-1/2 P_t S^-1/2 of some components, means over the steps of each run, (runs, k), descending."""
        some = np.ix_(index, index)
        counted = self.total.counted
        S, T = ((M[counted][:, some[0], some[1]]) for M in (self.P + self.P_t, self.P_t))
        L = np.linalg.cholesky(S)
        half = np.linalg.solve(L, T)
        values = np.full((*counted.shape, len(index)), np.nan)
        values[counted] = np.linalg.eigvalsh(np.linalg.solve(L, np.swapaxes(half, 1, 2)))[:, ::-1]
        return mean_of_runs(values)[counted.any(axis=1)].clip(0.0, 1.0)

    @cached_property
    def groups(self) -> Mapping[str, list[int]]:
        """All components (MAIN), and each group of the sample."""
        return {MAIN: list(range(self.total.dof))} | dict(self.total.known_errors.groups)

    @cached_property
    def by_group(self) -> Mapping[str, Array]:
        """:meth:`eigenvalues` of each group."""
        return {key: self.eigenvalues(index) for key, index in self.groups.items()}

    def share(self, group: str = MAIN) -> float:
        """s of a group: the part of P_t in both covariances; NaN where nothing is judged."""
        values = self.by_group[group]
        return float(values.mean()) if len(values) else float("nan")

    @property
    def unjudged(self) -> str:
        """Why nothing is decided; '' where something may be."""
        if self.contrasted or not self.share() > MOST:
            return ""
        return (
            f"the truth is less certain than the estimates: its covariance is {100 * self.share():.0f} % of both, and "
            f"at most {100 * MOST:.0f} % can be judged"
        )

    # --- questions --------------------------------------------------------------------------------

    def p_values(self, p_values: Mapping[str, float], settings: Settings) -> dict[str, float]:
        """p values of the questions that can be asked, from those that were asked of ``evidence``."""
        if not self.bounded and not self.contrasted:
            return dict(p_values)
        bias = self._bias()
        if self.contrasted:
            return dict(p_values) | bias
        p = {key: above if settings.one_sided else min(1.0, 2.0 * min(above, below))
             for key, (above, below) in self.tails.items()}  # fmt: skip
        axes = [value for key, value in p.items() if key != MAIN]
        return {MAIN: p[MAIN], AXIS: least(np.array(axes))[0] if self.total.dof > 1 else float("nan")} | bias

    @cached_property
    def tails(self) -> Mapping[str, tuple[float, float]]:
        """Of all components and each group: p values of a covariance that is too small, and of one too large."""
        return {key: (self.above(key), self.below(key)) for key in self.by_group}

    def above(self, group: str = MAIN, ratio: float = 1.0) -> float:
        """p value of the covariance of e being at most ``ratio`` P, under any dependence of the errors of the truth."""
        values = self.by_group[group]
        if not len(values):
            return float("nan")
        mean = float(self.total.group_means(self.groups[group]).mean()) / self._together
        return upper_tail(mean, upper_weights(values, ratio))

    def below(self, group: str = MAIN, ratio: float = 1.0) -> float:
        """p value of the covariance of e being at least ``ratio`` P, likewise."""
        if self.record.truth_shared:
            return 1.0
        index = self.groups[group]
        return scale_test(self._alone.group_means(index) / ratio, len(index), self.total.longest).below

    @cached_property
    def _alone(self) -> Sample:
        """Of d and P."""
        sample = sample_of(replace(self.record, nees=self.total.nees), Settings())
        assert sample is not None
        return sample

    def _bias(self) -> dict[str, float]:
        """p values of a mean error: by the spread of the runs, and beyond what the truth allows."""
        e, counted = self.total.known_errors, self.total.counted
        runs: Array = np.asarray(counted.any(axis=1))
        steps: Array = np.asarray(counted.any(axis=0))
        if runs.sum() <= self.total.dof:
            return dict.fromkeys(BIAS, float("nan"))
        error = np.where(counted[..., None], e.error, np.nan)
        P, T = (np.where(counted[..., None, None], M, np.nan).reshape(*counted.shape, -1) for M in (self.P, self.P_t))
        mean, stated, of_truth = (mean_of_runs(M)[runs].mean(axis=0) for M in (error, P, T))
        mean_k, stated_k, of_truth_k = (mean_of_runs(np.swapaxes(M, 0, 1))[steps] for M in (error, P, T))
        spread = hotelling(mean_of_runs(e.whitened)[runs]).p_value
        p = {BIAS[0]: max(spread, float(self._allowed(mean, stated, of_truth, np.array(runs.sum()))))}
        if len(steps) > 1:
            _, spreads = t_squared(e.whitened[:, steps])
            allowed = self._allowed(mean_k, stated_k, of_truth_k, counted.sum(axis=0)[steps])
            p[BIAS[1]] = least(np.maximum(spreads, allowed))[0]
        return p

    def _allowed(self, mean: Array, P: Array, P_t: Array, runs: Array) -> Array:
        """p values of mean errors (..., n), whose covariance is at most P / runs + P_t, (..., n n) each."""
        n = mean.shape[-1]
        most = (P / runs[..., None] + P_t).reshape(*mean.shape, n) * self._together
        return np.asarray(
            distributions.chi2.sf((mean * np.linalg.solve(most, mean[..., None])[..., 0]).sum(axis=-1), n)
        )

    def equivalence(self, sample: Sample, settings: Settings, factor: float) -> Equivalence:
        """Whether the ratio of P is shown to lie in [1 / factor, factor]."""
        if not self.bounded:
            share = 0.0 if self.contrasted else self.share()
            return equivalence(sample.means(), sample.dof, sample.longest, settings, factor, share=share)
        return equivalent(self.below(ratio=factor), self.above(ratio=1.0 / factor), factor, settings, None)

    # --- output -----------------------------------------------------------------------------------

    def of_estimate(self, v: Verdict) -> Verdict:
        """The verdict with every ratio that of P, and with the mean error and its size, whatever was judged."""
        axes = {key: self.share(key) for key in self.by_group if key != MAIN}
        truth = TruthShare(self.share(), axes, self.record.truth_errors, self.record.truth_shared)
        v = replace(v, truth=truth, status=self._status(v))
        if v.scale is None or v.axes is None or v.bias is None or v.location is None or not v.scale.judged_steps:
            return v
        if self.contrasted:
            answers = {a.question: a for a in v.answers}
            assert v.accuracy is not None
            size = accuracy_of(self.total)
            known = replace(
                v.accuracy, rmse=size.rmse, rmse_position=size.rmse_position, rmse_heading=size.rmse_heading
            )
            w = self.total.known_errors.whitened
            clearest = None if w.shape[1] == 1 else least(t_squared(w)[1])[1]  # whatever the truth allows
            mean = bias_of(self.total, clearest, v.location, answers)
            return replace(v, accuracy=known, bias=replace(mean, inflation_without=v.bias.inflation_without))
        within, until, largest = v.scale.within, v.location.until, v.axes.largest
        scale = replace(
            v.scale,
            inflation=self._of_P(v.scale.inflation, MAIN),
            detectable=self._of_P(Interval(*[v.scale.detectable] * 3), MAIN).value,
            within=None if within is None else replace(within, ratio=self._of_P(within.ratio, MAIN)),
            accepted=self._accepted(v) if self.bounded else v.scale.accepted,
        )
        axes_of = {key: self._of_P(interval, key) for key, interval in v.axes.inflation.items()}
        without = v.bias.inflation_without
        if until is not None:
            early = self._of_P(Interval(*[until.early] * 3), MAIN).value
            until = replace(until, early=early, late=self._of_P(until.late, MAIN))
        return replace(
            v, scale=scale,
            axes=replace(v.axes, inflation=axes_of, largest=None if largest is None else self._of_P(largest, MAIN)),
            bias=replace(v.bias, inflation_without=None if without is None else self._of_P(without, MAIN)),
            location=replace(v.location, until=until),
        )  # fmt: skip

    def _status(self, v: Verdict) -> str:
        """The headline: where only bounds hold, by the side of what they found."""
        faults = set(v.faults)
        if not self.bounded or not faults & {MAIN, AXIS, *BIAS} or v.status == "heavy-tailed":
            return v.status
        if faults & set(BIAS):
            about = float(self.total.centred_means(slice(None)).mean()) / self._together
            rate = at_share(v).false_alarm * SHARES[MAIN] / 2.0
            return "overconfident" if upper_tail(about, upper_weights(self.by_group[MAIN])) <= rate else "biased"
        tails = [self.tails[MAIN]]
        if MAIN not in faults:
            axes = [pair for key, pair in self.tails.items() if key != MAIN]
            tails = [pair for pair in axes if 2.0 * min(pair) * len(axes) <= v.settings.false_alarm] or axes
        sides = {"overconfident" if above < below else "conservative" for above, below in tails}
        return sides.pop() if len(sides) == 1 else "inconsistent"

    def _accepted(self, v: Verdict) -> tuple[float, float]:
        """Interval of the mean NEES by both covariances that is no fault of the scale; too large a one shows by P."""
        rate = at_share(v).false_alarm * SHARES[MAIN] / (1.0 if v.settings.one_sided else 2.0)
        weights = upper_weights(self.by_group[MAIN])
        low = beyond(weights)
        high = (
            low
            if upper_tail(low, weights) <= rate
            else float(optimize.brentq(lambda x: upper_tail(x, weights) - rate, low, 1e6 * low))
        )
        return 0.0, high * self._together * self.total.dof

    def _of_P(self, of_both: Interval, group: str) -> Interval:
        """Ratio of P from that of both covariances; with its widest interval where only bounds hold."""
        s = self.share(group)
        value, low, high = of_both
        if self.bounded:
            k = self.by_group[group].shape[1]
            most = (
                s * float(distributions.chi2.ppf(0.5 * (1.0 + CONFIDENCE), k)) / k
            )  # of the truth, if all its errors are one
            low -= most
            if self.record.truth_shared:
                low = max(np.sqrt(of_both.low) - np.sqrt(most), 0.0) ** 2
                high = (np.sqrt(of_both.high) + np.sqrt(most)) ** 2
        else:
            low, high = low - s, high - s
        return Interval(*(float(max(end, 0.0) / (1.0 - s)) for end in (value - s, low, high)))


def uncertain_truth(record: Record) -> UncertainTruth | None:
    """The truth of a record, where it has a covariance of its own and errors are judged."""
    if record.truth_covariance is None or record.error is None or record.covariance is None:
        return None
    return UncertainTruth(record)


def of_both(record: Record) -> Record:
    """The record with covariances and NEES of estimate and truth together, as it is drawn."""
    truth = uncertain_truth(record)
    return record if truth is None else replace(truth.both, nees=truth.total.nees)


def upper_weights(eigenvalues: Array, ratio: float = 1.0) -> Array:
    """Weights l of chi-square(1) whose sum the mean NEES of d by S, over n, exceeds at most as often, far out.

    Errors of runs are independent, and otherwise e and v depend on themselves in any way. The mean NEES is a quadratic
    form of jointly Gaussian e and v. Its weights are the eigenvalues of V'V = sum V_i' V_i for the blocks V_i of their
    whitened factor, and so majorised by the sums of the eigenvalues of the blocks, each in descending order (Fan 1949):
    all e of a run are one, and all v are. With d/dl_i P(Q > x) the density of Q + l_i chi-square(2) at x, the tail is
    Schur-convex in l where the density of Q + l_i chi-square(2) + l_j chi-square(2) falls, which it does beyond its
    mean, sum l + 4 max l at most (Bock, Diaconis, Huffer & Perlman 1987).

    Parameters
    ----------
    eigenvalues : (runs, n), those of S^-1/2 P_t S^-1/2, means over the steps of each run, descending
    ratio : of the covariance of e to P
    """
    runs, n = eigenvalues.shape
    weights = np.sort(ratio * (1.0 - eigenvalues).ravel() / (runs * n))[::-1]
    weights[:n] += eigenvalues.mean(axis=0) / n
    return weights


def beyond(weights: Array) -> float:
    """Where the tail of :func:`upper_weights` begins to hold."""
    return float(weights.sum() + 4.0 * weights.max())


def upper_tail(mean: float, weights: Array) -> float:
    """p value of a mean NEES over n by :func:`upper_weights`; 1 where the tail does not hold yet."""
    return 1.0 if mean < beyond(weights) else weighted_chi_square_tail(mean, weights)


def contrasts(error: Array, P: Array) -> tuple[Array, Array]:
    """Errors less the mean of those of the runs before, and their covariances; without what all runs share.

    u_i = (d_i - mean_j<i d_j) sqrt(m / (m + 1)) with m runs before has the covariance
    (P_i + mean_j<i P_j / m) m / (m + 1), and is not correlated with the others where P is that of all runs. The
    first run that has a value in a step has none left.

    Parameters
    ----------
    error, P : (runs, steps, n), (runs, steps, n, n); NaN where a value does not count
    """
    counted: Array = np.asarray(np.isfinite(error).all(axis=2) & np.isfinite(P).all(axis=(2, 3)))
    m: Array = np.cumsum(counted, axis=0) - counted
    e, S = np.where(counted[..., None], error, 0.0), np.where(counted[..., None, None], P, 0.0)
    first: Array = np.asarray(m[..., None] == 0)
    many = np.maximum(m, 1)[..., None]
    before, stated = (np.cumsum(e, axis=0) - e) / many, (np.cumsum(S, axis=0) - S) / many[..., None]
    kept = np.where(first | ~counted[..., None], np.nan, many / (many + 1.0))
    return (error - before) * np.sqrt(kept), (P + stated / many[..., None]) * kept[..., None]
