"""Parts and the functions chosen by their types: what is refused, what is cached, who compiles."""

from typing import NamedTuple

import numpy as np
import pytest

import consistency as cs
from consistency.bench.filters.compiler.dispatch import fits, generic, implement, part, require_fitting
from consistency.bench.filters.filter_inputs import problem_of
from consistency.bench.filters.methods.riekf import RightInvariant
from consistency.bench.filters.methods.ukf import Unscented
from consistency.bench.filters.parts.local import Local


@part()
class Doubling(NamedTuple):
    """A part of this test."""


@part()
class Twofold(NamedTuple):
    """Another part of this test."""


class Stranger(NamedTuple):
    """No part."""


@generic()
def times(rule, x):
    """x, multiplied."""
    raise NotImplementedError


@implement(times, Doubling)
def doubled(rule, x):
    return 2.0 * x


def another_doubling():
    namespace = {"__name__": __name__, "NamedTuple": NamedTuple}
    exec("class Doubling(NamedTuple):\n    pass\n", namespace)
    cls = namespace["Doubling"]
    assert isinstance(cls, type)
    return cls


def test_two_parts_of_one_name_are_refused():
    """They would run each other's compiled code, silently."""
    with pytest.raises(TypeError, match=r"a part named 'Doubling' is there already, in .*test_dispatch"):
        part()(another_doubling())


def test_a_part_must_be_a_named_tuple_at_module_level():
    class Inside(NamedTuple):
        pass

    for cls in (Inside, int):
        with pytest.raises(TypeError, match="NamedTuple at module level"):
            part()(cls)


def test_bodies_must_stand_at_module_level_and_alone():
    def body(rule, x):
        return x

    with pytest.raises(TypeError, match="module level"):
        implement(times, Stranger)(body)
    with pytest.raises(TypeError, match="'times' has a body for Doubling already"):
        implement(times, Doubling)(doubled)


def test_two_bodies_of_one_name_are_refused():
    namespace = {"__name__": __name__}
    exec("def doubled(rule, x):\n    return x\n", namespace)
    with pytest.raises(TypeError, match=r"'.*test_dispatch.doubled' must .* under a name of its own"):
        implement(times, Stranger)(namespace["doubled"])


def test_one_body_may_serve_two_parts():
    assert implement(times, Twofold)(doubled) is doubled
    assert times(Twofold(), 3.0) == 6.0


def test_a_function_without_a_body_says_what_there_is():
    assert times(Doubling(), 3.0) == 6.0
    with pytest.raises(TypeError, match="'times' has no body for Stranger; there are Doubling"):
        times(Stranger(), 3.0)


def parts(name, world):
    scenario = cs.load_scenario(world)
    trial = cs.simulate(scenario.variant("short", truth__steps=3))
    slam = cs.get_filter(name).parts(problem_of(trial, scenario.belief), np.array(trial.controls))
    return slam


REFUSED = [
    (
        "kf",
        "linear-gaussian",
        {"update": Unscented(1.0, 0.0, 0.0)},
        "point 'Reference' .* update 'Unscented', only with",
    ),
    ("ekf-uvd", "herath2007-stereo", {"point": parts("kf", "linear-gaussian").point}, "sensor 'Uvd'"),
    ("ri-ekf-uvd", "herath2007-stereo", {"covariance": Local(100)}, "covariance 'Local'"),
    ("ekf-uvd", "herath2007-stereo", {"error": RightInvariant(), "covariance": Local(100)}, "'RightInvariant'"),
    ("ekf-uvd", "herath2007-stereo", {"motion": Stranger()}, "motion: 'Stranger' is not a registered part"),
]


@pytest.mark.parametrize("name, world, changes, message", REFUSED, ids=lambda value: str(value)[:20])
def test_combinations_that_mean_nothing_are_refused(name, world, changes, message):
    slam = parts(name, world)
    require_fitting(slam)
    with pytest.raises(TypeError, match=message):
        require_fitting(slam._replace(**changes))
    assert not fits(slam._replace(**changes))
