"""What is shown, by how much and where: axes, opposite axes, correlations of the wrong sign, steps on both sides.

Faults are so large that a verdict at a false-alarm rate of 1e-5 misses them less often than that; the seed is fixed
and was not chosen.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from draws import fully_dependent, identities, independent
from scipy import stats

from consistency.diagnostics import Settings, judge, make_record
from consistency.referee.diagnostics.fault_words import bias_text, scale_text, shape_text
from consistency.referee.diagnostics.number_words import ratio_text, short
from consistency.referee.diagnostics.sentences import reasons
from consistency.referee.diagnostics.verdict_parts import Interval
from consistency.referee.show.blocks import Quantity
from consistency.referee.show.terminal import show
from consistency.referee.verdicts.tables import TERMINAL, document, rows

SURE = 1e-5
AXES = ("x", "y", "heading")


def judged(error, stated=None, **settings):
    P = identities(error) if stated is None else np.broadcast_to(stated, (*error.shape, error.shape[-1]))
    axes = AXES[: error.shape[-1]]
    return judge(make_record("f", error, P, axes=axes), Settings(**{"false_alarm": SURE} | settings))  # type: ignore[arg-type]


def correlated(rng, true, stated, n=2, runs=100):
    """Errors of x and y with one correlation, and the covariance that states another."""
    C, S = np.eye(n), np.eye(n)
    C[0, 1] = C[1, 0] = true
    S[0, 1] = S[1, 0] = stated
    return independent(rng, runs, 30, n) @ np.linalg.cholesky(C).T, S


# --- the worst axis ----------------------------------------------------------------------------------------


def test_the_worst_axis_stands_beside_the_whole(rng, capsys):
    error = independent(rng, 50, 6, 3) * np.sqrt([1.0, 1.0, 1.3])
    verdict = judged(error)
    assert verdict.status == "consistent"
    ratio = float(np.square(error[..., 2]).mean())
    name, interval = verdict.worst_axis or ("", Interval(0.0, 0.0, 0.0))
    assert name == "heading"
    assert interval.value == pytest.approx(ratio)
    beside = f"worst axis: heading, {ratio:.2f} [{interval.low:.2f}, {interval.high:.2f}]"
    assert f"({beside})" in verdict.reasons[0]
    assert re.search(rf"worst axis +heading, {ratio:.2f} \[", str(verdict))
    assert verdict.statistics["worst_axis"] == "heading"
    assert verdict.statistics["worst_axis_ratio"] == tuple(interval)
    show(*document({"f": verdict}, reasons=False).opening)
    assert "worst axis" not in capsys.readouterr().out  # the reasons of a single verdict have it
    show(*document({"f": verdict, "g": verdict}, reasons=False).opening)
    assert f"ratio of the {beside.replace(':', ': f')}" in capsys.readouterr().out
    few = judged(error[:5])
    assert few.status == "undecided"
    assert few.worst_axis is not None
    assert few.worst_axis[1].holds(1.0)
    assert "worst axis" not in few.reasons[0]
    show(*document({"f": few}, reasons=False).opening)
    assert "worst axis" not in capsys.readouterr().out + str(few)


def test_a_fault_that_begins_late_has_its_ratio_over_all_steps_too(rng):
    """Whatever the false-alarm rate makes of its beginning, the ratio over all steps is the same."""
    error = independent(rng, 60, 40, 3)
    error[:, 20:] *= np.sqrt([4.0, 4.0, 9.0])
    line = {}
    for rate in (SURE, 0.05):
        verdict = judged(error, false_alarm=rate)
        assert verdict.location.since in range(19, 24)
        [line[rate]] = [text for text in verdict.reasons if text.startswith("covariance ratio of the worst axis")]
    whole, inside = np.square(error).mean(), np.square(error[:, verdict.location.since - 1 :])
    assert f"worst axis since step {verdict.location.since}: heading, {inside[..., 2].mean():.2f} [" in line[0.05]
    assert f"; position {inside[..., :2].mean():.2f} [" in line[0.05]
    assert "attitude" not in line[0.05]  # which is the worst axis
    assert f"; all axes {inside.mean():.2f} [" in line[0.05]
    assert f"], in sigmas x{np.sqrt(inside.mean()):.2f}; over all steps {whole:.2f}" in line[0.05]
    assert line[SURE].endswith(f"; over all steps {whole:.2f}")


def test_a_fault_of_all_steps_has_one_ratio(rng):
    [line] = [text for text in judged(2.0 * independent(rng, 60, 20, 2)).reasons if "worst axis" in text]
    assert "over all steps" not in line
    assert "position" not in line  # of a state without attitude


def test_the_worst_axis_of_a_fault_is_to_its_side(rng):
    for factor, status, name in ((4.0, "overconfident", "x"), (0.25, "conservative", "heading")):
        verdict = judged(independent(rng, 60, 10, 3) * np.sqrt(factor * np.array([1.2, 1.0, 0.83])))
        assert verdict.status == status
        assert (verdict.worst_axis or ("",))[0] == name
        assert any(line.startswith(f"covariance ratio of the worst axis: {name}, ") for line in verdict.reasons)


def test_a_small_axis_may_be_the_worst(rng):
    error = independent(rng, 50, 6, 3) * np.sqrt([1.05, 0.6, 1.2])
    assert (judged(error).worst_axis or ("",))[0] == "y"
    assert (judged(error, allow="conservative").worst_axis or ("",))[0] == "heading"
    assert judged(error[..., :1]).worst_axis is None
    assert judge(make_record("f", nees=np.square(error).sum(axis=-1), dof=3)).worst_axis is None


# --- opposite axes -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("factors", [(1.4, 0.7), (1.5, 0.6, 1.2), (0.33, 1.4), (0.5, 0.6, 1.4)])
def test_opposite_axes_are_inconsistent(rng, factors):
    verdict = judged(independent(rng, 200, 40, len(factors)) * np.sqrt(factors))
    assert "scale of an axis" in verdict.faults
    assert verdict.status == "inconsistent"
    small, large = AXES[int(np.argmax(factors))], AXES[int(np.argmin(factors))]
    sentence = verdict.reasons[0]
    said = re.search(
        rf"too small by x([\d.]+) \[[^]]+\] in {small}, (?:.*?, )??too large by x([\d.]+) \[[^]]+\]", sentence
    )
    assert float(said[1]) == pytest.approx(max(factors), rel=0.1)
    assert float(said[2]) == pytest.approx(1.0 / min(factors), rel=0.1)
    assert float(re.search(rf"\(ratio ([\d.]+)\) in {large}", sentence)[1]) == pytest.approx(min(factors), rel=0.1)  # type: ignore[index]


@pytest.mark.parametrize(
    "factors, axis",
    [((1.3, 0.5), "y"), ((0.9, 0.9, 1.25), "heading"), ((1.2, 0.2), "y"), ((2.0, 2.0), None), ((1.9, 1.4), None)],
)
def test_an_axis_that_decides_stands_beside_the_status(rng, factors, axis):
    """A whole that looks right hides it: status, table, facts and JSON name it with its ratio."""
    verdict = judged(independent(rng, 200, 40, len(factors)) * np.sqrt(factors))
    (cell,) = (m.cell(verdict) for m in TERMINAL if m.column.head == "true / stated")
    if axis is None:
        assert verdict.axis is None
        assert "axis" not in verdict.statistics
        assert "decided by" not in dict(rows(verdict))
        assert isinstance(cell, Quantity)
        return
    interval = verdict.axes.inflation[axis]
    assert verdict.axis == (axis, interval)
    assert verdict.statistics["axis"] == axis
    assert verdict.statistics["axis_ratio"] == tuple(interval)
    assert verdict.statistics["ratio"] == verdict.inflation  # of the whole, as ever
    assert dict(rows(verdict))["decided by"].startswith(f"{axis}, {short(interval.value)} [")
    assert str(cell) == f"{ratio_text(interval)} in {axis}"


@pytest.mark.parametrize("times, status", [(8.3, "inconsistent"), (12.0, "heavy-tailed")])
def test_few_large_errors_do_not_hide_that_the_mean_is_small(times, status):
    """Quantiles of chi-square, so that there is no chance in it: most runs are smaller than stated, 15 larger."""
    few, most = (stats.chi2.ppf((np.arange(runs) + 0.5) / runs, 2) for runs in (15, 135))
    nees = 0.36 * np.concatenate([most, times * few])[:, None]
    verdict = judge(make_record("f", nees=nees, dof=2), Settings(0.01))
    assert (verdict.scale.inflation.high < 1.0) == (status == "inconsistent")
    assert verdict.status == status
    if status == "inconsistent":
        assert re.search(r"covariance too large by x[\d.]+ .*\(ratio 0\.\d\d\); the runs differ", verdict.reasons[0])


def test_an_axis_nearer_to_one_than_the_whole_leaves_it_overconfident(rng):
    verdict = judged(independent(rng, 100, 60, 2) * np.sqrt([3.0, 0.7]))
    assert verdict.status == "overconfident"
    sentence = verdict.reasons[0]
    assert re.search(
        r"too small by x1\.\d\d \[[^]]+\](?:, first .*)?; x too small by x\d\.\d\d \[[^]]+\], "
        r"y too large by x1\.\d\d \[[^]]+\] \(ratio 0\.\d\d\)",
        sentence,
    )


# --- correlations --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("stated", [-0.6, 0.6])
def test_a_correlation_of_the_wrong_sign_is_called_that(rng, n, stated):
    """With x, y and a heading the group of x and y is wrong, and no axis is."""
    verdict = judged(*correlated(rng, -stated, stated, n))
    assert "scale" in verdict.faults
    assert verdict.status == "inconsistent"
    sentence = verdict.reasons[0]
    said = re.search(r"correlation of the wrong sign: ([+-][\d.]+), stated ([+-][\d.]+), of x and y; no axis", sentence)
    assert float(said[1]) == pytest.approx(-stated, abs=0.08)
    assert float(said[2]) == stated
    assert "too small" not in sentence
    assert verdict.statistics["correlation_wrong_sign"]


def test_a_correlation_of_the_right_sign_is_not(rng):
    verdict = judged(*correlated(rng, 0.2, 0.8))
    assert verdict.status == "overconfident"
    assert "wrong sign" not in verdict.reasons[0]
    assert "correlation +0." in verdict.reasons[0]
    assert not verdict.statistics["correlation_wrong_sign"]
    unstated = judged(*correlated(rng, 0.6, 0.0))
    assert "wrong sign" not in unstated.reasons[0]


def test_a_sign_that_chance_makes_is_none(rng):
    """A true correlation of -0.05 in 40 runs of one step each: its sign is not known."""
    verdict = judged(
        np.repeat(correlated(rng, -0.05, 0.7, runs=40)[0][:, :1], 3, axis=1), np.array([[1, 0.7], [0.7, 1]])
    )
    assert not verdict.statistics["correlation_wrong_sign"]


def test_a_wrong_scale_beside_a_wrong_sign_is_still_one(rng):
    error, stated = correlated(rng, 0.6, -0.6)
    verdict = judged(2.0 * error, stated)
    assert verdict.status == "overconfident"
    assert "covariance too small by x" in verdict.reasons[0]
    assert "; correlation of the wrong sign: +0." in verdict.reasons[0]
    assert "no axis by itself" not in verdict.reasons[0]


# --- axes too large, and a correlation that makes one direction too small -------------------------------------


@pytest.mark.parametrize("stated, size", [(-0.97, 4.0), (0.97, 4.0), (-0.97, 2.0)])
def test_a_wrong_correlation_of_axes_that_are_too_large_is_inconsistent(rng, stated, size):
    error, S = correlated(rng, 0.1, stated)
    verdict = judged(error, size * S)
    assert verdict.status == "inconsistent"
    found = re.match(
        r"inconsistent: covariance too large by x([\d.]+) .* in [xy], too large by .* in [xy], "
        r"but too small by x([\d.]+) in one direction; covariance of the wrong shape: "
        r"correlation ([+-][\d.]+), stated ([+-][\d.]+)",
        verdict.reasons[0],
    )
    assert found, verdict.reasons[0]
    assert float(found[1]) == pytest.approx(size, rel=0.2)
    worst = (1.0 + 0.1 if stated < 0 else 1.0 - 0.1) / (1.0 - 0.97) / size
    assert float(found[2]) == pytest.approx(worst, rel=0.2)  # the direction in which the stated variance is least
    assert (float(found[3]), float(found[4])) == (pytest.approx(0.1, abs=0.08), stated)
    assert "mainly" not in verdict.reasons[0]
    assert judged(error, size * S, allow="conservative").status == "overconfident"


@pytest.mark.parametrize("x, y", [(0.5, 1.0), (0.5, 4.0)])
def test_an_axis_that_is_too_small_beside_a_wrong_correlation_is_overconfident(rng, x, y):
    error, S = correlated(rng, 0.1, -0.97)
    verdict = judged(error, S * np.sqrt(np.outer([x, y], [x, y])))
    assert verdict.status == "overconfident"


def test_the_axes_that_are_named_err_as_the_whole(rng):
    """Else one is the main axis of a covariance that is too small, and twelve times too large itself."""
    error, S = correlated(rng, 0.1, -0.99, n=3)
    verdict = judged(error, S * np.sqrt(np.outer([12.0, 12.0, 1.0], [12.0, 12.0, 1.0])))
    assert verdict.scale.inflation.low > 1.0
    assert verdict.location.subset is None
    assert verdict.status == "inconsistent"


# --- steps -----------------------------------------------------------------------------------------------------


def test_steps_above_and_below_are_counted_apart(rng):
    """Four steps from the 11th far below, one, the 41st, above by less."""
    error = independent(rng, 100, 100, 2)
    error[:, 10:14] *= 0.3
    error[:, 40] *= 1.45
    verdict = judged(error)
    assert verdict.status == "conservative"
    ratio = np.square(error).mean(axis=(0, 2))
    least = ratio[10:14].min()
    assert verdict.reasons[0].startswith(
        f"conservative: covariance too large by up to x{1.0 / least:.1f} (ratio {least:.2g}) in 4 of 100 steps, "
        "first in step 11, and too small in 1, first in step 41"
    )
    assert "too small by" not in verdict.reasons[0]
    turned = judged(error[:, :20])
    assert "too small" not in turned.reasons[0]


def only(verdict, question):
    """The verdict where this question alone found a fault."""
    answers = tuple(replace(answer, found=answer.question == question) for answer in verdict.answers)
    return replace(verdict, answers=answers)


def test_the_larger_side_comes_first(rng):
    error = independent(rng, 100, 100, 2)
    error[:, 10] *= 0.68
    error[:, 40:43] *= 2.2
    verdict = judged(error)
    location = replace(verdict.location, lasting=False)
    steps = replace(only(verdict, "scale in some step"), location=location, status="overconfident")
    said = scale_text(steps)
    worst = np.square(error).mean(axis=(0, 2)).max()
    assert said.startswith(f"covariance too small by up to x{worst:.2f} in 3 of 100 steps, first in step 41")


@pytest.mark.parametrize(
    "late, status, side", [(3.0, "conservative", "too large"), (0.3, "overconfident", "too small")]
)
def test_no_factor_to_the_other_side(rng, late, status, side):
    """A verdict on the whole whose late part errs to the other side: the factor is that of the whole."""
    error = independent(rng, 60, 20, 3) * np.sqrt(0.5 if status == "conservative" else 2.0)
    verdict = judged(error)
    assert verdict.status == status
    contrary = replace(verdict, scale=replace(verdict.scale, inflation=Interval(late, 0.9 * late, 1.1 * late)))
    sentence = reasons(contrary)[0]
    ratio = verdict.scale.mean_anees / 3
    both = f" (ratio {ratio:.2f})" if ratio < 1.0 else ""
    assert f"{side} by x{max(ratio, 1 / ratio):.2f}{both} in the mean of all steps" in sentence


# --- bias ------------------------------------------------------------------------------------------------------


def test_a_bias_in_a_step_has_a_size(rng):
    error = independent(rng, 100, 30, 3)
    error[:, 11, 1] -= 2.0
    verdict = judged(error)
    assert verdict.bias.size == pytest.approx(float(error[:, 11, 1].mean()))
    assert f"biased: mean error {verdict.bias.size:+.2f} sigma in y, in step 12" in verdict.reasons[0]
    assert verdict.statistics["bias_in_step"] == verdict.bias.size


def test_a_bias_of_no_axis_is_in_a_combination(rng):
    verdict = judged(fully_dependent(rng, 60, 4, 2) + 2.0)
    none = replace(verdict, bias=replace(verdict.bias, by_axis={}))
    assert bias_text(none, False).startswith("mean error in a combination of axes; without the bias")


def test_a_shape_in_a_step_says_which(rng):
    error = independent(rng, 200, 12, 2)
    error[:, 4, 1] = 0.95 * error[:, 4, 0] + np.sqrt(1 - 0.95**2) * error[:, 4, 1]
    verdict = judged(error)
    assert verdict.faults[0] == "shape in some step"
    assert re.search(
        r"correlation \+0\.9\d, stated \+0\.00, of x and y in step 5$", shape_text(only(verdict, "shape in some step"))
    )


# --- components by themselves ------------------------------------------------------------------------------


def test_a_sentence_names_three_wrong_components_and_counts_the_rest(rng):
    axes = ("a", "b", "c", "d", "e")
    error = 3.0 * independent(rng, 60, 20, 5)
    record = make_record("f", error, identities(error), axes=axes, parts=tuple((k,) for k in range(5)))
    sentence = judge(record, Settings(false_alarm=SURE)).reasons[0]
    assert [f"{axis}: covariance too small" in sentence for axis in axes] == [True, True, True, False, False]
    assert sentence.endswith("; and 2 more")
