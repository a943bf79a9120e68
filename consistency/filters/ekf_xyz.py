"""EKF-SLAM on points (x, y, z), converted from (u, v, d) by eq. 21 where the sensor is stereo."""

from typing import Any

from consistency.filters.compiled import Compiled
from consistency.filters.jit import kernel
from consistency.filters.observation import XYZ
from consistency.filters.rules import linearised
from consistency.filters.textbook import ExtendedKalman
from consistency.filters.trial import compose_trial

_run_trial = compose_trial(linearised(XYZ), XYZ)


@kernel
def run_ekf_xyz(
    controls: Any, first: Any, landmark: Any, z: Any, R: Any, n: int, start: Any, path0: Any, landmarks0: Any,
    q: Any, rig: Any, points: Any,
) -> Any:  # fmt: skip
    return _run_trial(controls, first, landmark, z, R, n, start, path0, landmarks0, q, rig, points)


FILTER = Compiled(ExtendedKalman("ekf-xyz", uvd=False), run_ekf_xyz, sensors=("xyz", "uvd"))
