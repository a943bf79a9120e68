"""Have the errors of dynamax's filters and smoother the covariance that they state?"""

import jax
import numpy as np
from linear import AXES, STEADY, H, textbook
from study import Case

jax.config.update("jax_enable_x64", True)
from dynamax.linear_gaussian_ssm import inference as linear  # noqa: E402 - after the precision is set
from dynamax.nonlinear_gaussian_ssm import (  # noqa: E402
    ParamsNLGSSM,
    UKFHyperParams,
    extended_kalman_filter,
    unscented_kalman_filter,
)  # fmt: skip

F, Q, R = STEADY.F[0], STEADY.Q[0], np.array([[STEADY.R]])


def curved():
    return ParamsNLGSSM(np.zeros(2), STEADY.P0, lambda x: F @ x, Q, lambda x: H @ x, R)


def judged(data):
    truth, z = data
    params = linear.make_lgssm_params(np.zeros(2), STEADY.P0, F, Q, H, R)
    smooth = jax.vmap(lambda y: linear.lgssm_smoother(params, y))(z[..., None])
    extended = jax.vmap(lambda y: extended_kalman_filter(curved(), y))(z[..., None])
    unscented = jax.vmap(lambda y: unscented_kalman_filter(curved(), y, UKFHyperParams()))(z[..., None])
    found = {"filter": smooth, "EKF": extended, "UKF": unscented}
    out = {name: (truth - each.filtered_means, each.filtered_covariances) for name, each in found.items()}
    return {**out, "smoother": (truth - smooth.smoothed_means, smooth.smoothed_covariances)}


def second():
    return [each for name in ("filter", "EKF", "UKF", "smoother")
            for each in STEADY.exact(name, lambda data, name=name: judged(data)[name])]  # fmt: skip


CASE = Case("dynamax", AXES, 117, STEADY.simulate, judged, textbook, second)

if __name__ == "__main__":
    CASE.main()
