"""UKF-SLAM on points (x, y, z), converted from (u, v, d) by eq. 21 where the sensor is stereo."""

from consistency.filters.compiled import Compiled
from consistency.filters.observation import XYZ
from consistency.filters.rules import UNSCENTED
from consistency.filters.textbook import Unscented

FILTER = Compiled(Unscented("ukf-xyz", uvd=False), rule=UNSCENTED, model=XYZ, sensors=("xyz", "uvd"))
