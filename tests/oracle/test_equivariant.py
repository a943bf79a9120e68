"""The output matrix of the equivariant filter: right to third order along the group, where a Jacobian is to second."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from consistency.bench.filters.kernel.part_functions import measure, measure_jacobian
from consistency.bench.filters.methods import equivariant
from consistency.bench.filters.methods.equivariant import sight, to_polar
from consistency.bench.filters.parts.sensors import Uvd
from consistency.bench.scenario.models import Mounting

SENSOR = Uvd(150.0, 0.09, Mounting(0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1))
Q, EPS = np.array([3.0, 0.7, -0.4]), np.array([0.2, -0.1, 0.15])  # m; rad, rad, logarithm


def truth(eps):
    """Where the landmark is if the estimate Q errs by eps."""
    left, up, n = np.reshape(sight(Q)[0], (3, 3))
    turn = Rotation.from_rotvec(eps[0] * np.cross(n, left) + eps[1] * np.cross(n, up))
    return np.asarray(np.exp(eps[2]) * turn.apply(Q))


def missing(scale, averaged):
    """What the linear output leaves of the difference in px, for errors ``scale`` times EPS."""
    z = np.array(measure(SENSOR, *truth(scale * EPS)))
    H, none = np.reshape(measure_jacobian(SENSOR, *Q), (3, 3)).copy(), np.zeros((3, 3))
    to_polar(equivariant.Polar(), np.zeros(3), Q, none, H)
    if averaged:
        equivariant._average(SENSOR, z, Q, H)
    return float(np.linalg.norm(z - measure(SENSOR, *Q) - H @ (scale * EPS)))


@pytest.mark.parametrize("averaged, order", [(False, 2), (True, 3)])
def test_the_order_of_the_output(averaged, order):
    ratio = missing(0.1, averaged) / missing(0.01, averaged)
    assert np.log10(ratio) == pytest.approx(order, abs=0.1)


def test_axes_of_the_line_of_sight():
    left, up, n = np.reshape(sight(Q)[0], (3, 3))
    assert sight(Q)[1] == pytest.approx(np.linalg.norm(Q))
    assert n == pytest.approx(Q / np.linalg.norm(Q))
    assert np.cross(n, left) == pytest.approx(up)
    assert left[2] == 0.0
    assert up[2] > 0.0
    assert np.isfinite(sight(np.array([0.0, 0.0, 2.0]))[0]).all()  # straight above
