"""Have the errors of statsmodels' smoother the stated covariance, where a third of the measurements is missing?"""

import numpy as np
from linear import AXES, STEADY, H, textbook
from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother
from study import Case

MISSING = np.arange(STEADY.steps) % 3 == 1


def judged(data):
    truth, z, means, covariances = *data, [], []
    for run in z:
        model = KalmanSmoother(k_endog=1, k_states=2)
        model["design"], model["obs_cov"], model["selection"] = H, np.array([[STEADY.R]]), np.eye(2)
        model["transition"], model["state_cov"] = STEADY.F[0], STEADY.Q[0]
        model.initialize_known(np.zeros(2), STEADY.P0)
        model.bind(np.where(MISSING, np.nan, run)[:, None])
        found = model.smooth()
        means.append(found.smoothed_state.T)
        covariances.append(np.moveaxis(found.smoothed_state_cov, -1, 0))
    return {"smoother": (truth - means, np.array(covariances))}


def second():
    return STEADY.exact("smoother", lambda data: judged(data)["smoother"])


CASE = Case("statsmodels", AXES, 117, STEADY.simulate, judged, textbook, second)

if __name__ == "__main__":
    CASE.main()
