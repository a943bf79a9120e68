"""Have the errors of simdkalman's filter and smoother the covariance that they state?"""

import numpy as np
import simdkalman
from linear import AXES, STEADY, H, textbook
from study import Case


def judged(data):
    truth, z = data
    kf = simdkalman.KalmanFilter(STEADY.F[0], STEADY.Q[0], H, STEADY.R)
    found = kf.compute(z, 0, initial_value=np.zeros(2), initial_covariance=STEADY.P0, filtered=True, smoothed=True)
    return {name: (truth - part.states.mean, part.states.cov) for name, part in
            (("filter", found.filtered), ("smoother", found.smoothed))}  # fmt: skip


def second():
    names = "filter", "smoother"
    return [each for name in names for each in STEADY.exact(name, lambda data, name=name: judged(data)[name])]


CASE = Case("simdkalman", AXES, 117, STEADY.simulate, judged, textbook, second)

if __name__ == "__main__":
    CASE.main()
