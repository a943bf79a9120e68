"""Cubature SLAM, Arasaratnam & Haykin (2009): the unscented filter with its points fixed to the cubature rule.

The third-degree spherical-radial rule has 2 L points at +-sqrt(L) columns of a root of P, with weights 1 / (2 L) and no
centre. Sigma points with alpha = 1, beta = kappa = 0 are these, and are the default of a belief: then ``ckf`` and
``ukf`` are one filter. This one has them whatever the belief says of sigma points. L counts the variables that f or h
reads, as in ``textbook/ukf.py``; a rule over the whole state would have a spread that grows with the map.
"""

from __future__ import annotations

from consistency.bench.filters.textbook.ukf import UnscentedKalman
from consistency.bench.scenario import SigmaPoints

CUBATURE = SigmaPoints(alpha=1.0, beta=0.0, kappa=0.0)


class CubatureKalman(UnscentedKalman):
    """UKF-SLAM whose sigma points are those of the cubature rule."""

    def __init__(self, name: str, uvd: bool) -> None:
        super().__init__(name, uvd, points=CUBATURE)
