"""The linear Kalman filter, exact in a linear-Gaussian world, Herath et al. (2007) eq. 1-8."""

from typing import Any

from consistency.filters.compiled import Compiled
from consistency.filters.jit import kernel
from consistency.filters.observation import LINEAR
from consistency.filters.rules import fixed
from consistency.filters.textbook import LinearKalman
from consistency.filters.trial import compose_trial

_run_trial = compose_trial(fixed(LINEAR), LINEAR)


@kernel
def run_kf(
    controls: Any, first: Any, landmark: Any, z: Any, R: Any, n: int, start: Any, path0: Any, landmarks0: Any,
    q: Any, rig: Any, points: Any,
) -> Any:  # fmt: skip
    return _run_trial(controls, first, landmark, z, R, n, start, path0, landmarks0, q, rig, points)


FILTER = Compiled(LinearKalman("kf", uvd=False), run_kf, sensors=("linear",))
