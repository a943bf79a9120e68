"""The worlds of groups that the calibration counts: right filters, and columns that select on the outcome."""

import calibration_groups as groups
import numpy as np
import pytest

import consistency as cs


@pytest.mark.parametrize("world", groups.WORLDS)
def test_the_errors_of_a_world_have_the_covariance_that_they_state(world):
    """Mean NEES over all steps of 400 runs, with weights by steps: six standard errors, 1e-8 a world."""
    error, covariance, values = groups.WORLDS[world].draw(np.random.default_rng(4), 400)
    nees = groups._nees(error, covariance)
    assert values.shape == nees.shape
    excess = np.nansum(nees - error.shape[-1], axis=1)
    assert abs(excess.mean()) < 6.0 * excess.std() / np.sqrt(len(excess))


@pytest.mark.parametrize("world", groups.CONTROL)
def test_a_control_states_no_fault_of_a_group_though_its_ratios_differ(world):
    draw, _ = groups.CONTROL[world]
    table, column = draw(np.random.default_rng(5))
    assert not groups._states_a_group(table, column)
    if column != "score":
        ratios = [group.ratio.value for group in cs.judge(cs.read(table, state=["x"], by=column)).by_group.groups]
        assert max(ratios) > 2.0 * min(ratios)


def test_one_group_of_five_is_wrong_by_the_ratio():
    verdict, wrong = groups._with_one_wrong(np.random.default_rng(6), 400, alone=True)
    of = {group.name: group for group in verdict.by_group.groups}
    assert of[wrong].runs == 80
    assert of[wrong].ratio.value == max(group.ratio.value for group in of.values())
