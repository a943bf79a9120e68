"""The monitor: its likelihood ratios by integration, its evidence by the definition, and what it makes of a change."""

import copy
import math
import pickle
import re
import runpy

import numpy as np
import pytest
from documents import blocks
from scipy import special, stats

import consistency as cs
from consistency.referee.diagnostics.monitor import (
    RATIOS,
    alternatives,
    bet_on,
    gate_limit,
    gated_mean,
    gated_scale,
    log_chi2_cdf,
    start_share,
)
from consistency.referee.verdicts.monitor_sources import read_innovations, watch


def fed(monitor, nis, dof):
    """Alarms of a series of NIS with the same degrees of freedom."""
    return [alarm for value in nis if (alarm := monitor.update(value, dof)) is not None]


NODES, WEIGHTS = np.polynomial.legendre.leggauss(300)


def expectation(function, scale, dof, limit):
    """E function(NIS) of scale x chi-square(dof), given that it is at most ``limit``.

    Gauss-Legendre over the square root of the NIS, where the density has no pole, as far as no alternative has
    any probability beyond.
    """
    end = min(limit, scale * stats.chi2.isf(1e-16, dof) * max(RATIOS))
    root = math.sqrt(end) * (NODES + 1) / 2
    values = np.array([function(x) for x in root * root])
    density = stats.chi2.pdf(root * root / scale, dof) / scale * 2 * root
    return float(math.sqrt(end) / 2 * (WEIGHTS * values * density).sum() / stats.chi2.cdf(limit / scale, dof))


# --- the likelihood ratios -----------------------------------------------------------------------------


@pytest.mark.parametrize("gate", [None, 0.99, 0.95])
@pytest.mark.parametrize("tolerance", [1.0, 1.2])
@pytest.mark.parametrize("dof", [1, 2, 3, 7])
def test_no_scale_within_the_tolerance_is_bet_against_with_profit(dof, tolerance, gate):
    """E LR is 1 at the edge, at most 1 within, and above 1 at the alternative itself (negative control)."""
    bet = bet_on(dof, tolerance, gate)
    limit = math.inf if gate is None else stats.chi2.ppf(gate, dof)
    assert bet.limit == limit
    for (scale, edge), (constant, slope) in zip(alternatives(tolerance), bet.terms, strict=True):

        def ratio(nis, constant=constant, slope=slope):
            return math.exp(constant + slope * nis)

        assert expectation(ratio, edge, dof, limit) == pytest.approx(1.0, abs=1e-9)
        for within in (1 / tolerance, 1.0, math.sqrt(tolerance), tolerance):
            assert expectation(ratio, within, dof, limit) <= 1.0 + 1e-9
        beyond = edge * (scale / edge) ** 0.2
        assert expectation(ratio, beyond, dof, limit) > 1.0 + 1e-6


def test_shares_add_up_to_one():
    terms = 10**6
    head = math.fsum(start_share(k) for k in range(1, terms + 1))
    tail = 1 / math.log(terms + 1)  # at least the sum of 1 / (n ln^2 n) over n > terms + 1, by the integral
    assert head + tail / 2.109742 <= 1.0 + 1e-7
    assert head + 1 / math.log(terms + 2) / 2.10975 > 1.0 - 1e-5
    assert start_share(1) == pytest.approx(0.4933, abs=1e-3)
    for mission in (1, 7, 1000):
        shares = [start_share(k, mission) for k in range(1, 2000)]
        assert math.fsum(shares) == pytest.approx(1.0, abs=1e-12)
        assert shares[0] == pytest.approx(0.5 + 0.5 / mission)
        assert shares[mission:] == [0.0] * (1999 - mission)


# --- the chi-square behind a gate ----------------------------------------------------------------------


def test_the_distribution_function_does_not_underflow():
    for x, dof in ((0.3, 1), (5.0, 3), (2.0, 40), (900.0, 1000)):
        assert log_chi2_cdf(x, dof) == pytest.approx(math.log(stats.chi2.cdf(x, dof)), rel=1e-10)
    for x, dof in ((100.0, 3000), (1500.0, 4000), (3.0e4, 1.0e5), (1e-200, 4)):
        assert special.gammainc(dof / 2, x / 2) < 1e-290
        # F_k(x) - F_{k+2}(x) = (x/2)^(k/2) e^(-x/2) / Gamma(k/2 + 1)
        step = dof / 2 * math.log(x / 2) - x / 2 - math.lgamma(dof / 2 + 1)
        rest = math.log1p(-math.exp(log_chi2_cdf(x, dof + 2) - log_chi2_cdf(x, dof)))
        assert log_chi2_cdf(x, dof) + rest == pytest.approx(step, rel=1e-9)


@pytest.mark.parametrize("dof", [1, 3, 10])
@pytest.mark.parametrize("scale", [0.3, 1.0, 1.7])
def test_the_scale_behind_a_gate_is_recovered(dof, scale):
    limit = gate_limit(0.99, dof)
    mean = expectation(lambda nis: nis, scale, dof, limit)
    assert gated_mean(scale, dof, limit) == pytest.approx(mean, rel=1e-6)
    assert gated_scale(mean, dof, 0.99) == pytest.approx(scale, rel=1e-5)
    assert gated_scale(0.0, dof, 0.99) == 0.0
    assert gated_scale(limit * dof / (dof + 2), dof, 0.99) == math.inf
    assert gated_scale(2.0 * dof, dof, None) == 2.0


# --- the evidence --------------------------------------------------------------------------------------


def by_definition(nis, dof, tolerance, mission):
    """Mean over alternatives of the sum over starts of share x product of density ratios, and the shares to come."""
    total, edges = 0.0, [tolerance] * len(RATIOS) + [1 / tolerance] * len(RATIOS)
    scales = [tolerance * ratio for ratio in RATIOS] + [1 / (tolerance * ratio) for ratio in RATIOS]
    for scale, edge in zip(scales, edges, strict=True):
        ratio = [
            stats.chi2.pdf(x / scale, d) / scale / (stats.chi2.pdf(x / edge, d) / edge)
            for x, d in zip(nis, dof, strict=True)
        ]
        total += sum(start_share(s + 1, mission) * math.prod(ratio[s:]) for s in range(len(nis)))
    return total / len(scales) + 1 - sum(start_share(s + 1, mission) for s in range(len(nis)))


@pytest.mark.parametrize("mission", [None, 20])
@pytest.mark.parametrize("tolerance", [1.0, 1.2])
def test_evidence_by_its_definition(tolerance, mission):
    rng = np.random.default_rng()
    dof = rng.integers(1, 4, 30).tolist()
    nis = (1.3 * rng.chisquare(dof)).tolist()
    monitor = cs.Monitor(1e-9, tolerance, mission=mission)
    assert monitor.evidence == 1.0
    for x, d in zip(nis, dof, strict=True):
        monitor.update(x, d)
        monitor.update(None, 0)
    assert monitor.evidence == pytest.approx(by_definition(nis, dof, tolerance, mission), rel=1e-9)
    assert (monitor.steps, monitor.innovations) == (60, 30)
    assert monitor.ratio == pytest.approx(sum(nis) / sum(dof))
    assert monitor.largest >= max(monitor.evidence, 1.0)


@pytest.mark.parametrize("gate", [None, 0.99])
def test_the_evidence_of_a_right_filter_is_a_martingale(gate):
    """Its expectation after the next innovation is what it is now, wherever it is."""
    rng = np.random.default_rng()
    monitor = cs.Monitor(1e-9, tolerance=1.0, gate=gate)
    limit = math.inf if gate is None else gate_limit(gate, 2)
    for value in (0.7, 1.9, *rng.chisquare(2, 3).clip(max=4.0)):

        def after(nis, before=copy.deepcopy(monitor)):  # noqa: B008
            following = copy.deepcopy(before)
            following.update(nis, 2)
            return following.evidence

        assert expectation(after, 1.0, 2, limit) == pytest.approx(monitor.evidence, rel=1e-9)
        monitor.update(float(value), 2)


def test_an_alarm_is_raised_at_the_inverse_of_the_rate():
    for false_alarm in (0.2, 0.01):
        monitor, before = cs.Monitor(false_alarm, tolerance=1.0), 1.0
        while not (alarm := monitor.update(2.6, 2)):  # evidence that grows by a few percent a step
            before = monitor.evidence
            assert monitor.steps < 10_000
        assert before < monitor.threshold <= alarm.evidence < 1.1 * monitor.threshold
        assert monitor.threshold == pytest.approx(1 / false_alarm)
        assert (alarm.evidence, alarm.step) == (monitor.evidence, monitor.steps)


# --- since when, in which direction, by how much --------------------------------------------------------


@pytest.mark.parametrize("tolerance", [1.0, 1.2])
@pytest.mark.parametrize("ratio, direction", [(3.0, "overconfident"), (0.2, "conservative")])
def test_a_change_is_found_with_its_step_direction_and_scale(ratio, direction, tolerance):
    monitor = cs.Monitor(tolerance=tolerance)
    assert not fed(monitor, [3.0] * 200, 3)  # exactly the expected value
    alarms = fed(monitor, [3.0 * ratio] * 200, 3)
    assert len(alarms) == 1  # once, and kept
    alarm = alarms[0]
    assert monitor.alarm is alarm
    assert (alarm.since, alarm.direction) == (201, direction)
    assert alarm.scale == pytest.approx(ratio)
    assert 201 < alarm.step < 280
    assert alarm.outlier is None
    assert "outlier" not in str(alarm)
    assert monitor.evidence > alarm.evidence  # still counted


@pytest.mark.parametrize("ratio, direction", [(1.07, "overconfident"), (0.93, "conservative")])
def test_the_direction_of_a_small_fault(ratio, direction):
    """The alternatives nearest to 1 on either side are the best there."""
    alarm = fed(cs.Monitor(tolerance=1.0), [300.0 * ratio] * 200, 300)[0]
    assert alarm.direction == direction
    assert alarm.scale == pytest.approx(ratio)


def test_since_when_by_its_definition():
    """The step after the one at which the sum of log ratios of the r with the largest R was lowest."""
    rng = np.random.default_rng()
    constant, slope = np.array(bet_on(2, 1.0).terms).T
    for _ in range(100):
        monitor, nis = cs.Monitor(0.05, tolerance=1.0), []
        while monitor.alarm is None:
            nis.append((1.0 if monitor.steps < 30 else 1.8) * rng.chisquare(2))
            monitor.update(nis[-1], 2)
        steps = len(nis)
        walk = np.vstack([np.zeros(len(slope)), np.cumsum(constant + slope * np.array(nis)[:, None], axis=0)])
        shares = np.array([start_share(k) for k in range(1, steps + 1)])
        R = (shares[:, None] * np.exp(walk[-1] - walk[:-1])).sum(axis=0)
        best = int(R.argmax())
        lowest = steps - int(np.argmin(walk[::-1, best]))  # the last one, if there are several
        assert monitor.alarm.since == lowest + 1
        assert monitor.alarm.scale == pytest.approx(np.mean(nis[lowest:]) / 2)
        assert monitor.alarm.direction == ("overconfident" if best < len(RATIOS) else "conservative")


def test_scales_within_the_tolerance_raise_nothing_and_begin_nothing():
    monitor = cs.Monitor(0.5, tolerance=1.2)
    assert not fed(monitor, [1.2 * 3.0, 3.0 / 1.2] * 5000, 3)
    assert monitor.largest == 1.0
    alarm = fed(monitor, [9.0] * 100, 3)[0]
    assert alarm.since == 10_001
    assert fed(cs.Monitor(0.5, tolerance=1.0), [1.2 * 3.0] * 5000, 3)  # negative control: the exact test alarms


def test_steps_without_an_innovation_count_as_steps_only():
    monitor, dense = cs.Monitor(), cs.Monitor()
    for nis, dof in ((2.0, 2), (7.0, 2), (3.0, 2), (12.0, 2), (15.0, 2), (14.0, 2), (30.0, 2)):
        for nothing in ((None, 0), (math.nan, 0), (math.nan, 2), (None, 3), (0.0, 0)):
            assert monitor.update(*nothing) is None
        first, second = monitor.update(nis, dof), dense.update(nis, dof)
        assert monitor.evidence == dense.evidence
        assert (first is None) == (second is None)
        if first and second:
            assert first.step == 6 * second.step
            # the first step after the reset, which was 5 steps before the next innovation
            assert first.since == 6 * (second.since - 1) + 1
    assert dense.alarm is not None
    assert monitor.rejections == 0


def test_numbers_of_numpy_will_do():
    plain, numpy = cs.Monitor(), cs.Monitor()
    for value in (1.0, 9.0, 4.0):
        plain.update(value, 3)
        numpy.update(np.float64(value), np.int64(3))
    assert plain.evidence == numpy.evidence
    assert type(numpy.evidence) is float


# --- the gate ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gate, rest", [(0.99, 2), (0.999, 2), (0.95, 5), (0.98, 5)])
@pytest.mark.parametrize("rejected", [1e6, None, math.nan])
def test_a_rejection_is_no_evidence_and_the_next_innovations_are_not_judged(rejected, gate, rest):
    monitor = cs.Monitor(gate=gate)
    fed(monitor, [3.0, 5.0], 3)
    before = monitor.evidence
    monitor.update(rejected, 3)
    monitor.update(0.1, 3)
    monitor.update(rejected, 3)  # begins the rest anew
    for _ in range(rest):
        monitor.update(None, 0)  # a step without a measurement does not shorten it
        monitor.update(0.1, 3)
        assert monitor.evidence == before
    assert (monitor.rejections, monitor.innovations, monitor.measurements) == (2, 2, 5 + rest)
    monitor.update(0.1, 3)
    assert monitor.evidence != before
    assert monitor.innovations == 3


def test_a_nis_at_the_limit_is_accepted():
    monitor, limit = cs.Monitor(gate=0.99), gate_limit(0.99, 3)
    monitor.update(limit, 3)
    assert (monitor.innovations, monitor.rejections) == (1, 0)
    monitor.update(limit * (1 + 1e-12), 3)
    assert (monitor.innovations, monitor.rejections) == (1, 1)
    assert limit == pytest.approx(11.3449, abs=1e-4)  # tables of chi-square


def test_the_scale_of_an_alarm_allows_for_the_gate():
    limit = gate_limit(0.99, 3)
    monitor = cs.Monitor(gate=0.99)
    fed(monitor, [gated_mean(1.0, 3, limit)] * 100, 3)
    assert monitor.scale == pytest.approx(1.0)
    assert monitor.ratio < 0.97
    alarm = fed(monitor, [gated_mean(2.0, 3, limit)] * 500, 3)[0]
    assert alarm.scale == pytest.approx(2.0, rel=1e-6)
    assert alarm.since == 101
    hidden = fed(cs.Monitor(gate=0.99), [0.95 * limit] * 500, 3)[0]
    assert hidden.scale == math.inf
    assert "larger than a gate lets see" in str(hidden)


# --- limits --------------------------------------------------------------------------------------------


def test_nothing_overflows():
    monitor = cs.Monitor()
    alarm = monitor.update(1e300, 1)
    assert alarm.direction == "overconfident"
    for value in (1.7e308, 1.7e308, 0.0, 5e-324, 1.7e308):
        monitor.update(value, 3)
    fed(monitor, [0.0] * 2000, 3)
    fed(monitor, [3.0] * 2000, 3)
    assert 0.0 <= monitor.evidence < math.inf
    monitor.reset()
    assert fed(monitor, [0.0] * 5000, 1)[0].direction == "conservative"
    for gate in (None, 0.99):
        many = cs.Monitor(gate=gate)
        assert not fed(many, [1e5] * 5, 100_000)
        assert many.evidence < 1.0
        assert fed(many, [0.7e5] * 2, 100_000)[0].direction == "conservative"


def test_memory_does_not_grow_and_a_stored_monitor_goes_on():
    rng = np.random.default_rng()
    monitor, sizes = cs.Monitor(gate=0.99), []
    for _ in range(2):
        fed(monitor, rng.chisquare(3, 3000).tolist(), 3)
        stored = pickle.dumps(monitor)
        sizes.append(len(stored))
    assert sizes[1] < sizes[0] + 200
    assert sizes[1] < 4000
    restored = pickle.loads(stored)
    for value in rng.chisquare(3, 50).tolist():
        monitor.update(value, 3)
        restored.update(value, 3)
    assert restored.evidence == monitor.evidence


def test_reset_starts_anew():
    monitor, new = cs.Monitor(gate=0.99), cs.Monitor(gate=0.99)
    fed(monitor, [9.0] * 200 + [100.0], 3)
    assert monitor.alarm is not None
    monitor.reset()
    assert monitor.alarm is None
    assert {k: v for k, v in vars(monitor).items() if k != "_bets"} == {
        k: v for k, v in vars(new).items() if k != "_bets"
    }
    assert len(fed(monitor, [9.0] * 200, 3)) == 1


@pytest.mark.parametrize(
    "nis, dof, said",
    [
        (-0.1, 3, "nis must be 0 or more and finite, got -0.1"),
        (math.inf, 3, "nis must be 0 or more and finite, got inf"),
        (-math.inf, 3, "nis must be 0 or more"),
        (1.0, 1.5, "dof must be a whole number of 0 or more, got 1.5"),
        (1.0, -1, "dof must be a whole number"),
        (None, math.nan, "dof must be a whole number"),
        (None, math.inf, "dof must be a whole number"),
    ],
)
def test_refused_values_leave_everything_as_it_was(nis, dof, said):
    monitor = cs.Monitor()
    fed(monitor, [3.0, 4.0], 3)
    before = copy.deepcopy(vars(monitor))
    with pytest.raises(ValueError, match=re.escape(said)):
        monitor.update(nis, dof)
    assert vars(monitor) == before


@pytest.mark.parametrize(
    "options, said",
    [
        ({"false_alarm": 0.0}, "false_alarm must lie between 0 and 1"),
        ({"false_alarm": 1.0}, "false_alarm must lie between 0 and 1"),
        ({"tolerance": 0.9}, "tolerance must be 1 or more"),
        ({"tolerance": math.inf}, "tolerance must be 1 or more"),
        ({"gate": 0.9}, "gate must be a probability of at least 0.95"),
        ({"gate": 1.0}, "gate must be a probability"),
        ({"gate": 9.21}, "gate must be a probability"),
        ({"mission": 0}, "mission must be a whole number"),
        ({"mission": 2.5}, "mission must be a whole number"),
    ],
)
def test_refused_options(options, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        cs.Monitor(**options)


# --- words ---------------------------------------------------------------------------------------------


def test_the_sentence_says_what_is_judged_and_what_is_not():
    alarm = fed(cs.Monitor(), [2.0] * 10 + [9.0] * 100, 2)[0]
    said = str(alarm)
    assert f"alarm in step {alarm.step}: overconfident since step 11" in said
    assert "x4.5" in said
    assert "x0.833 to x1.2 is accepted" in said
    assert "alarm at 1000" in said
    assert "Only the NIS is judged, under a gain declared optimal" in said
    assert "neither the direction of an alarm nor silence says anything about the pose" in said
    with pytest.raises(AttributeError):
        alarm.step = 3  # type: ignore[misc]
    for text in (cs.Monitor.__doc__, cs.Alarm.__doc__):
        assert text is not None
        assert "optimal" in text
        assert "pose" in text


def test_the_example_of_the_manual(tmp_path, capsys):
    (tmp_path / "example.py").write_text(blocks("docs/monitor.md", "python")[0].text)
    runpy.run_path(str(tmp_path / "example.py"))
    printed = capsys.readouterr().out.split()
    assert printed == blocks("docs/monitor.md", "text")[0].text.split()
    assert printed[:3] == ["alarm", "in", "step"]


# --- one outlier ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "nis, dof, before", [(49.0, 2, 0), (60.0, 1, 0), (40.0, 2, 0), (60.0, 1, 1), (90.0, 2, 50), (300.0, 6, 50)]
)
def test_an_outlier_is_no_fault_since(nis, dof, before, tmp_path):
    """NIS of exactly 1 a degree of freedom beside it; the log as a whole tells that nothing else is wrong."""
    values = np.array([*[dof] * before, nis, *[dof] * 99], float)
    monitor = cs.Monitor()
    (alarm,) = fed(monitor, values, dof)
    assert (alarm.step, alarm.since, alarm.outlier) == (before + 1,) * 3
    assert "overconfident since" not in str(alarm)
    assert "the NIS of this step is an outlier" in str(alarm)
    assert math.isnan(alarm.rest) if not before else alarm.rest == 1.0
    t = np.arange(len(values)) / 10.0
    np.savez(tmp_path / "log.npz", nis=values, nis_dof=np.full(len(values), dof), t=t)
    whole = watch(read_innovations(tmp_path / "log.npz"), cs.Monitor()).alarm
    assert (whole.outlier, whole.rest) == (before + 1, 1.0)
    assert "overconfident since" not in str(whole)
    assert "that of the others x1," in str(whole)


@pytest.mark.parametrize("scale", [3.0, 8.0, 24.5])
def test_a_fault_with_outliers_keeps_its_beginning(scale):
    """Each NIS is ``scale`` from step 101 on, but for one of 200: what is left since then is a fault by itself."""
    monitor = cs.Monitor()
    (alarm,) = fed(monitor, [1.0] * 100 + [scale] * 2 + [200.0] + [scale] * 60, 1)
    assert f"overconfident since step {alarm.since}; scale" in str(alarm)
    assert alarm.outlier in (None, 103)
    assert alarm.outlier is None or alarm.rest == pytest.approx(scale)
    assert alarm.since == 101
