"""Cubature SLAM, Arasaratnam & Haykin (2009): the unscented filter with its points fixed to the cubature rule.

The third-degree spherical-radial rule has 2 L points at +-sqrt(L) columns of a root of P, with weights 1 / (2 L) and no
centre. Sigma points with alpha = 1, beta = kappa = 0 are these, and are the default of a belief: then ``ckf`` and
``ukf`` are one filter. This one has them whatever the belief says of sigma points. L counts the variables that f or h
reads, as in ``update/unscented.py``; a rule over the whole state would have a spread that grows with the map.
"""

from __future__ import annotations

from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.kernel.slam import Slam
from consistency.bench.filters.methods import ukf
from consistency.bench.filters.update.unscented import Unscented
from consistency.bench.protocols import Problem
from consistency.bench.scenario import SigmaPoints
from consistency.referee.types import Array

CUBATURE = SigmaPoints(alpha=1.0, beta=0.0, kappa=0.0)


def xyz_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``ckf-xyz``."""
    points = Unscented(CUBATURE.alpha, CUBATURE.beta, CUBATURE.kappa)
    return ukf.xyz_parts(problem, controls)._replace(update=points)


def uvd_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``ckf-uvd``."""
    return xyz_parts(problem, controls)._replace(sensor=ukf.uvd_parts(problem, controls).sensor)


XYZ = Compiled(ukf.UnscentedKalman("ckf-xyz", uvd=False, points=CUBATURE), xyz_parts, sensors=("xyz", "uvd"), uvd=False)
UVD = Compiled(ukf.UnscentedKalman("ckf-uvd", uvd=True, points=CUBATURE), uvd_parts, sensors=("uvd",), uvd=True)
