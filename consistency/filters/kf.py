"""The linear Kalman filter, exact in a linear-Gaussian world, Herath et al. (2007) eq. 1-8."""

from consistency.filters.compiled import Compiled
from consistency.filters.observation import LINEAR
from consistency.filters.rules import FIXED
from consistency.filters.textbook import LinearKalman

FILTER = Compiled(LinearKalman("kf", uvd=False), rule=FIXED, model=LINEAR, sensors=("linear",), innovations="optimal")
