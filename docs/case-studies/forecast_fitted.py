"""Has the forecast of statsmodels' AR(2) the error that its variance states, with parameters from 25 observations?"""

import numpy as np
from statsmodels.tsa.ar_model import AutoReg
from study import Argument, Case

LENGTH, AHEAD, PHI, BURN = 25, 3, (1.2, -0.5), 100
KNOWN = 1 + PHI[0] ** 2 + (PHI[0] ** 2 + PHI[1]) ** 2  # variance of a forecast 3 ahead, of noise of variance 1


def ahead(y, phi):
    """The forecast, by the recursion without noise."""
    a, b = y[-2:]
    for _ in range(AHEAD):
        a, b = b, phi[0] * b + phi[1] * a
    return b


def simulate(rng, runs):
    e = rng.normal(size=(runs, BURN + LENGTH + AHEAD))
    y = np.zeros_like(e)
    for k in range(2, e.shape[1]):
        y[:, k] = PHI[0] * y[:, k - 1] + PHI[1] * y[:, k - 2] + e[:, k]
    return y[:, BURN:]


def fitted(y):
    forecast = AutoReg(y[:LENGTH], lags=2, trend="n").fit().get_prediction(LENGTH, LENGTH + AHEAD - 1)
    return forecast.predicted_mean[-1], forecast.var_pred_mean[-1]


def rows(series, forecast):
    means, variances = np.transpose([forecast(y) for y in series])
    return (series[:, -1] - means)[:, None], variances[:, None, None]


def judged(series):
    return {"parameters fitted": rows(series, fitted)}


def control(series):
    return {"parameters known": rows(series, lambda y: (ahead(y[:LENGTH], PHI), KNOWN))}


def second():
    """Mean squared errors over stated variances in 4,000 further series, without the referee."""
    errors, variances = rows(simulate(np.random.default_rng(1), 4000), fitted)
    return [Argument("parameters fitted", "mean of 4,000 further series", (errors**2 / variances[..., 0]).mean())]


CASE = Case("statsmodels", ("target",), 234, simulate, judged, control, second)

if __name__ == "__main__":
    CASE.main()
