"""EKF-SLAM on (u, v, d), Herath et al. (2007) eq. 22."""

from consistency.filters.compiled import Compiled
from consistency.filters.observation import UVD
from consistency.filters.rules import LINEARISED
from consistency.filters.textbook import ExtendedKalman

FILTER = Compiled(ExtendedKalman("ekf-uvd", uvd=True), rule=LINEARISED, model=UVD, sensors=("uvd",))
