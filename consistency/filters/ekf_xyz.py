"""EKF-SLAM on points (x, y, z), converted from (u, v, d) by eq. 21 where the sensor is stereo."""

from consistency.filters.compiled import Compiled
from consistency.filters.observation import XYZ
from consistency.filters.rules import LINEARISED
from consistency.filters.textbook import ExtendedKalman

FILTER = Compiled(ExtendedKalman("ekf-xyz", uvd=False), rule=LINEARISED, model=XYZ, sensors=("xyz", "uvd"))
