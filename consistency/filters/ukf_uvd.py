"""UKF-SLAM on (u, v, d), Herath et al. (2007) sec. 4.5."""

from consistency.filters.compiled import Compiled
from consistency.filters.observation import UVD
from consistency.filters.rules import UNSCENTED
from consistency.filters.textbook import Unscented

FILTER = Compiled(Unscented("ukf-uvd", uvd=True), rule=UNSCENTED, model=UVD, sensors=("uvd",))
