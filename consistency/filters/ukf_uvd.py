"""UKF-SLAM on (u, v, d), Herath et al. (2007) sec. 4.5."""

from typing import Any

from consistency.filters.compiled import Compiled
from consistency.filters.jit import kernel
from consistency.filters.observation import UVD
from consistency.filters.rules import unscented
from consistency.filters.textbook import Unscented
from consistency.filters.trial import compose_trial

_run_trial = compose_trial(unscented(UVD), UVD)


@kernel
def run_ukf_uvd(
    controls: Any, first: Any, landmark: Any, z: Any, R: Any, n: int, start: Any, path0: Any, landmarks0: Any,
    q: Any, rig: Any, points: Any,
) -> Any:  # fmt: skip
    return _run_trial(controls, first, landmark, z, R, n, start, path0, landmarks0, q, rig, points)


FILTER = Compiled(Unscented("ukf-uvd", uvd=True), run_ukf_uvd, sensors=("uvd",))
