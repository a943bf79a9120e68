"""Whose innovations are judged: those of filters that declare an optimal gain, from the filter to the verdict."""

import numpy as np
import pytest

import consistency as cs
from consistency.bench.protocols import optimal_gain
from consistency.bench.store.results import joined


class Declares:
    """The linear Kalman filter, behind an attribute of one's own."""

    name = "mine"

    def __init__(self, **attributes):
        self.inner = cs.get_filter("kf").textbook
        vars(self).update(attributes)

    def init(self, problem):
        return self.inner.init(problem)

    def predict(self, state, control):
        return self.inner.predict(state, control)

    def update(self, state, observation):
        return self.inner.update(state, observation)

    def pose(self, state):
        return self.inner.pose(state)


def test_kf_declares_it_and_filters_of_a_nonlinear_sensor_do_not(linear, uvd):
    assert cs.run_trials(linear, ["kf"], runs=1, jobs=1).manifest["optimal_gain"] == ["kf"]
    assert cs.run_trials(uvd, ["ekf-uvd", "ukf-uvd"], runs=1, jobs=1).manifest["optimal_gain"] == []


@pytest.mark.parametrize(
    "attributes, declared",
    [({}, False), ({"innovations": "optimal"}, True), ({"innovations": "gated"}, False),
     ({"innovations": np.zeros(3)}, False), ({"innovations": []}, False)],
)  # fmt: skip
def test_an_attribute_declares_it_and_whatever_else_it_holds_does_not(attributes, declared):
    assert optimal_gain(Declares(**attributes)) is declared


def test_what_is_declared_reaches_the_verdict(linear, tmp_path):
    silent = cs.run_trials(linear, [Declares()], runs=2, jobs=1)
    kf = cs.run_trials(linear, ["kf"], runs=2, jobs=1, out=tmp_path / "kf")
    for results, name, judged in ((silent, "mine", False), (kf, "kf", True), (cs.read_results(kf.folder), "kf", True)):
        verdict = cs.analyse(results)[name]
        assert verdict.innovations.judged is judged
        assert any(a.question == "innovation scale" for a in verdict.answers) is judged
    both = joined([silent, cs.read_results(kf.folder)])
    assert both.manifest["optimal_gain"] == ["kf"]
