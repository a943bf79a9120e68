"""Truth with a covariance of its own.

Errors are d = e + v, of which P alone is judged. A truth without a covariance needs nothing of this module.

Some errors are shared by all estimates. Each error is then e = J theta + n: theta, the same for all, has a prior, and
n the stated covariance plus a floor, the scatter of the truth. Both are fitted to some data by maximum likelihood,
with theta integrated out, and predicted for other data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy import optimize

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics import distributions
from consistency.referee.diagnostics.bias_and_shape import hotelling, t_squared
from consistency.referee.diagnostics.distributions import weighted_chi_square_tail
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.sample import Sample, sample_of
from consistency.referee.diagnostics.scale import MeanTest, equivalence, equivalent, scale_tests
from consistency.referee.diagnostics.verdict_parts import (
    AXIS,
    BIAS,
    MAIN,
    SHARES,
    Answer,
    Equivalence,
    ErrorParts,
    Interval,
    Settings,
    TruthShare,
    at_share,
    faults_of,
    least_of_steps,
)
from consistency.referee.diagnostics.whitening import mean_of_runs
from consistency.referee.errors import InputError
from consistency.referee.types import Array

DECLARED = ("independent", "per-run", "common")  # how errors of the truth depend on each other
UNDECIDABLE = 0.5  # share of the truth in both covariances beyond which nothing is decided
SHARED = 2.0  # (e + v)(e + v)' is at most twice ee' + vv', however e and v depend on each other
LEAST, MOST = 1e-7, 1.0  # m and rad, standard deviations of the floor that are looked at


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
        return r.truth.shared or r.truth.errors is None or (r.truth.errors == "common" and len(r.run_numbers) < 2)

    @property
    def _together(self) -> float:
        """Factor by which both covariances grow if e and v may depend on each other."""
        if self.record.truth.shared:
            return SHARED
        return 1.0

    @property
    def contrasted(self) -> bool:
        return self.record.truth.errors == "common" and not self.bounded

    @cached_property
    def P(self) -> Array:
        return np.asarray(self.record.errors.covariance, float)

    @cached_property
    def P_t(self) -> Array:
        assert self.record.truth.covariance is not None
        return np.asarray(self.record.truth.covariance, float)

    @cached_property
    def both(self) -> Record:
        """The record with the covariances of estimate and truth together."""
        errors = replace(self.record.errors, covariance=self.P + self.P_t)
        return replace(self.record, errors=errors, truth=replace(self.record.truth, covariance=None))

    @cached_property
    def evidence(self) -> Record:
        """The record of which questions are asked."""
        if not self.contrasted:
            return self.both
        assert self.record.errors.error is not None
        counted: Array = self.total.counted
        error, P = contrasts(np.where(counted[..., None], self.record.errors.error, np.nan), self.P)
        return self.both.with_errors(error, P)

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
        rows, columns = some
        T = self.P_t[counted][:, rows, columns]
        S = self.P[counted][:, rows, columns] + T
        L = np.linalg.cholesky(S)
        half = np.linalg.solve(L, T)
        values = np.full((*counted.shape, len(index)), np.nan)
        values[counted] = np.linalg.eigvalsh(np.linalg.solve(L, np.swapaxes(half, 1, 2)))[:, ::-1]
        return mean_of_runs(values)[counted.any(axis=1)].clip(0.0, 1.0)

    @cached_property
    def groups(self) -> Mapping[str, list[int]]:
        """All components (MAIN), and each group of the sample."""
        return {MAIN: list(range(self.total.dof))} | dict(self.total.components)

    @cached_property
    def by_group(self) -> Mapping[str, Array]:
        """:meth:`eigenvalues` of each group, and of velocity."""
        groups = {**self.groups, **self.total.reported}
        return {key: self.eigenvalues(index) for key, index in groups.items()}

    def share(self, group: str = MAIN) -> float:
        """s of a group: the part of P_t in both covariances; NaN where nothing is judged."""
        values = self.by_group[group]
        if not len(values):
            return float("nan")
        return float(values.mean())

    @property
    def unjudged(self) -> str:
        """Why nothing is decided; '' where something may be."""
        if self.contrasted or not self.share() > UNDECIDABLE:
            return ""
        return (
            f"the truth is less certain than the estimates: its covariance is {100 * self.share():.0f} % of both, and "
            f"at most {100 * UNDECIDABLE:.0f} % can be judged"
        )

    # --- questions --------------------------------------------------------------------------------

    def p_values(self, p_values: Mapping[str, float], settings: Settings) -> dict[str, float]:
        """p values of the questions that can be asked, from those that were asked of ``evidence``."""
        if not self.bounded and not self.contrasted:
            return dict(p_values)
        bias = self._bias()
        if self.contrasted:
            return dict(p_values) | bias
        of_axes = []
        of_all = float("nan")
        for key, (above, below) in self.tails.items():
            p = above
            if not settings.one_sided:
                p = min(1.0, 2.0 * min(above, below))
            if key == MAIN:
                of_all = p
            else:
                of_axes.append(p)
        of_axis = float("nan")
        if self.total.dof > 1:
            of_axis, _ = least_of_steps(np.array(of_axes))
        return {MAIN: of_all, AXIS: of_axis} | bias

    @cached_property
    def tails(self) -> Mapping[str, tuple[float, float]]:
        """Of all components and each group: p values of a covariance that is too small, and of one too large."""
        return {key: (self.above(key), self.below(key)) for key in self.groups}

    def above(self, group: str = MAIN, ratio: float = 1.0) -> float:
        """p value of the covariance of e being at most ``ratio`` P, under any dependence of the errors of the truth."""
        values = self.by_group[group]
        if not len(values):
            return float("nan")
        return upper_tail(self._mean_by_group[group] / self._together, upper_weights(values, ratio))

    def below(self, group: str = MAIN, ratio: float = 1.0) -> float:
        """p value of the covariance of e being at least ``ratio`` P, likewise."""
        if self.record.truth.shared:
            return 1.0
        return self._tests_alone[group](ratio).below

    @cached_property
    def _mean_by_group(self) -> Mapping[str, float]:
        """Mean NEES of d by S over its degrees of freedom."""
        return {key: float(self.total.group_means(index).mean()) for key, index in self.groups.items()}

    @cached_property
    def _tests_alone(self) -> Mapping[str, Callable[[float], MeanTest]]:
        """Tests that the covariance of d is P times a number."""
        return {
            key: scale_tests(self._alone.group_means(index), len(index), self.total.longest)
            for key, index in self.groups.items()
        }

    @cached_property
    def _alone(self) -> Sample:
        """Of d and P."""
        sample = sample_of(self.record.with_nees(self.total.nees), Settings())
        assert sample is not None
        return sample

    def _bias(self) -> dict[str, float]:
        """p values of a mean error: by the spread of the runs, and beyond what the truth allows."""
        whitened = self.total.whitened
        assert whitened is not None
        counted = self.total.counted
        runs: Array = np.asarray(counted.any(axis=1))
        steps: Array = np.asarray(counted.any(axis=0))
        if runs.sum() <= self.total.dof:
            return dict.fromkeys(BIAS, float("nan"))
        error = np.where(counted[..., None], self.total.error, np.nan)
        P = self._counted_entries(self.P)
        P_t = self._counted_entries(self.P_t)
        spread = hotelling(mean_of_runs(whitened)[runs]).p_value
        mean, stated, of_truth = (mean_of_runs(M)[runs].mean(axis=0) for M in (error, P, P_t))
        allowed = self._allowed(mean, stated, of_truth, np.array(runs.sum()))
        p = {BIAS[0]: max(spread, float(allowed))}
        if len(steps) > 1:
            _, spreads = t_squared(whitened[:, steps])
            mean, stated, of_truth = (mean_of_runs(np.swapaxes(M, 0, 1))[steps] for M in (error, P, P_t))
            in_steps = self._allowed(mean, stated, of_truth, counted.sum(axis=0)[steps])
            p[BIAS[1]], _ = least_of_steps(np.maximum(spreads, in_steps))
        return p

    def _counted_entries(self, matrices: Array) -> Array:
        """Entries of matrices in the steps that count, (runs, steps, n n), NaN elsewhere."""
        counted = self.total.counted
        return np.where(counted[..., None, None], matrices, np.nan).reshape(*counted.shape, -1)

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
            share = self.share()
            if self.contrasted:
                share = 0.0
            means = sample.run_means()
            test = means.tests(gaussian=False)
            return equivalence(
                means.values, means.dof, means.steps, settings, factor, share=share, is_whole=True, test=test
            )
        ratio = float("nan")
        if len(self.by_group[MAIN]):
            ratio = (float(self.total.means().mean()) - self.share()) / (1.0 - self.share())
        return equivalent(partial(self.below, MAIN), partial(self.above, MAIN), ratio, factor, settings)

    # --- output -----------------------------------------------------------------------------------

    def truth_share(self) -> TruthShare:
        """Share of the truth's own covariance in that of the errors."""
        axes = {key: self.share(key) for key in self.groups if key != MAIN}
        return TruthShare(self.share(), axes, self.record.truth.errors, self.record.truth.shared)

    def of_estimate(self, parts: ErrorParts, answers: Sequence[Answer], settings: Settings) -> ErrorParts:
        """The parts with every ratio that of P."""
        found = parts.with_ratios(self._of_P)
        assert found.scale is not None
        if self.bounded:
            # of the mean NEES by both covariances; too large a covariance shows by P
            rate = at_share(answers, settings).false_alarm * SHARES[MAIN]
            if not settings.one_sided:
                rate /= 2.0
            weights = upper_weights(self.by_group[MAIN])
            high = beyond(weights)
            if upper_tail(high, weights) > rate:
                high = float(optimize.brentq(lambda x: upper_tail(x, weights) - rate, high, 1e6 * high))
            accepted = 0.0, high * self._together * self.total.dof
            found = found._replace(scale=replace(found.scale, accepted=accepted))
        return found._replace(by_group=parts.by_group)

    def status(self, status: str, answers: Sequence[Answer], settings: Settings) -> str:
        """The status: where only bounds hold, by the side of what they found."""
        faults = set(faults_of(answers))
        if not self.bounded or not faults & {MAIN, AXIS, *BIAS} or status == "heavy-tailed":
            return status
        if faults & set(BIAS):
            about = float(self.total.centred_means(slice(None)).mean()) / self._together
            rate = at_share(answers, settings).false_alarm * SHARES[MAIN] / 2.0
            if upper_tail(about, upper_weights(self.by_group[MAIN])) <= rate:
                return "overconfident"
            return "biased"
        tails = [self.tails[MAIN]]
        if MAIN not in faults:
            axes = [pair for key, pair in self.tails.items() if key != MAIN]
            tails = [pair for pair in axes if 2.0 * min(pair) * len(axes) <= settings.false_alarm] or axes
        if all(above < below for above, below in tails):
            return "overconfident"
        if any(above < below for above, below in tails):
            return "inconsistent"
        return "conservative"

    def _of_P(self, of_both: Interval, group: str) -> Interval:
        """Ratio of P from that of both covariances; with its widest interval where only bounds hold."""
        share = self.share(group)
        low = of_both.low - share
        high = of_both.high - share
        if self.bounded:
            k = self.by_group[group].shape[1]
            # of the truth, if all its errors are one
            most = share * float(distributions.chi2.ppf(0.5 * (1.0 + CONFIDENCE), k)) / k
            low = of_both.low - most
            high = of_both.high
            if self.record.truth.shared:
                low = max(np.sqrt(of_both.low) - np.sqrt(most), 0.0) ** 2
                high = (np.sqrt(of_both.high) + np.sqrt(most)) ** 2
        value, low, high = (float(max(end, 0.0) / (1.0 - share)) for end in (of_both.value - share, low, high))
        return Interval(value, low, high)


def uncertain_truth(record: Record) -> UncertainTruth | None:
    """The truth of a record, where it has a covariance of its own and errors are judged."""
    if record.truth.covariance is None or record.errors.error is None or record.errors.covariance is None:
        return None
    return UncertainTruth(record)


def of_both(record: Record) -> Record:
    """The record with covariances and NEES of estimate and truth together, as it is drawn."""
    truth = uncertain_truth(record)
    if truth is None:
        return record
    return truth.both.with_nees(truth.total.nees)


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
    if mean < beyond(weights):
        return 1.0
    return weighted_chi_square_tail(mean, weights)


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
    e = np.where(counted[..., None], error, 0.0)
    S = np.where(counted[..., None, None], P, 0.0)
    first: Array = np.asarray(m[..., None] == 0)
    many = np.maximum(m, 1)[..., None]
    before = (np.cumsum(e, axis=0) - e) / many
    stated = (np.cumsum(S, axis=0) - S) / many[..., None]
    kept = np.where(first | ~counted[..., None], np.nan, many / (many + 1.0))
    return (error - before) * np.sqrt(kept), (P + stated / many[..., None]) * kept[..., None]


@dataclass(frozen=True, eq=False)
class SharedError:
    """What some data tell about the errors that all share."""

    mean: Array  # (m,), of theta
    covariance: Array  # (m, m)
    floor: Array  # (n,), standard deviations of the truth, in the units of the error

    def predict(self, J: Array, S: Array) -> tuple[Array, Array]:
        """Expected errors (N, n) of other estimates, and their covariances (N, n, n).

        Parameters
        ----------
        J : (N, n, m), derivative of each error by theta
        S : (N, n, n), stated covariances
        """
        shared = J @ self.covariance @ np.swapaxes(J, 1, 2)
        return J @ self.mean, S + shared + np.diag(self.floor**2)


def fit_shared_error(errors: Array, J: Array, S: Array, prior: Array) -> SharedError:
    """Shared errors and floor of highest likelihood.

    Parameters
    ----------
    errors : (N, n), against truth
    J : (N, n, m), derivative of each by what is shared
    S : (N, n, n), stated covariances
    prior : (m,), standard deviations of theta, whose mean is 0

    Raises
    ------
    InputError
        Fewer than 2 n errors, or shapes that do not fit.
    """
    N = errors.shape[0]
    n = errors.shape[-1]
    if errors.shape != (N, n) or J.shape != (N, n, len(prior)) or S.shape != (N, n, n):
        raise InputError(f"errors, J, S: shapes {errors.shape}, {J.shape}, {S.shape} do not fit")
    if 2 * n > N:
        raise InputError(f"errors: of {N} motions, at least {2 * n} are needed for a floor of {n} numbers")
    start = np.log(np.clip(errors.std(axis=0), 10.0 * LEAST, 0.1 * MOST))
    bounds = optimize.Bounds(np.full(n, np.log(LEAST)), np.full(n, np.log(MOST)))
    best = optimize.minimize(  # type: ignore[call-overload]  # the stubs do not know jac=True
        lambda x: posterior(np.exp(x), errors, J, S, prior)[2:], start, jac=True, method="L-BFGS-B", bounds=bounds
    )
    floor = np.exp(best.x)
    mean, covariance, *_ = posterior(floor, errors, J, S, prior)
    return SharedError(mean, covariance, floor)


def posterior(floor: Array, errors: Array, J: Array, S: Array, prior: Array) -> tuple[Array, Array, float, Array]:
    """Mean and covariance of what is shared; minus twice the log-likelihood, and its derivative by log floor.

    The errors (N, n) have the covariance V = C + J Pi J', with C that of each alone and Pi the prior.

    Parameters
    ----------
    floor : (n,), standard deviations
    J : (N, n, m)
    S : (N, n, n)
    prior : (m,), standard deviations
    """
    C = S + np.diag(floor**2)
    W = np.linalg.inv(C)
    WJ = W @ J
    H = np.einsum("nia,nib->ab", J, WJ) + np.diag(prior**-2.0)
    covariance = np.linalg.inv(H)
    mean = covariance @ np.einsum("nia,ni->a", WJ, errors)
    weighted = np.einsum("nij,nj->ni", W, errors - J @ mean)  # V^-1 e
    diagonal = np.einsum("nii->ni", W) - np.einsum("nia,ab,nib->ni", WJ, covariance, WJ)  # of V^-1
    volume = np.linalg.slogdet(C)[1].sum() + np.linalg.slogdet(H * np.outer(prior, prior))[1]
    slope = 2.0 * floor**2 * (diagonal - weighted**2).sum(axis=0)
    return mean, covariance, float((errors * weighted).sum() + volume), slope
