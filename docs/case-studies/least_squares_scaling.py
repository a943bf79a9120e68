"""What the default scaling of scipy's, lmfit's and numpy's fits makes of a told sigma: a parabola through 8 points."""

import lmfit
import numpy as np
from scipy.optimize import curve_fit
from study import Argument, Case

X, SIGMA, TRUE, AXES = np.linspace(-1, 1, 8), 0.5, np.array([1.0, -2.0, 3.0]), ("c2", "c1", "c0")
WEIGHTS = np.full(len(X), 1 / SIGMA)


def parabola(x, c2, c1, c0):
    return c2 * x**2 + c1 * x + c0


def by_scipy(y, absolute=False):
    return curve_fit(parabola, X, y, sigma=1 / WEIGHTS, absolute_sigma=absolute)


def by_lmfit(y, absolute=False):
    fit = lmfit.Model(parabola).fit(y, x=X, c2=1, c1=1, c0=1, weights=WEIGHTS, scale_covar=not absolute)
    return [fit.params[name].value for name in AXES], fit.covar


def by_numpy(y, absolute=False):
    return np.polyfit(X, y, 2, w=WEIGHTS, cov="unscaled" if absolute else True)


FITS = {"scipy curve_fit": by_scipy, "lmfit": by_lmfit, "numpy polyfit": by_numpy}


def simulate(rng, runs):
    return parabola(X, *TRUE) + rng.normal(0, SIGMA, (runs, len(X)))


def rows(draws, absolute):
    out = {}
    for name, fit in FITS.items():
        found = [fit(y, absolute) for y in draws]
        name += ", sigma taken as it is" if absolute else ", default scaling"
        out[name] = np.array([TRUE - x for x, _ in found]), np.array([P for _, P in found])
    return out


def second():
    """The scale is chi-square of 5 degrees of freedom over 5, independent of the errors: its inverse has mean 5/3."""
    return [Argument(f"{name}, default scaling", "5 / (5 - 2) degrees of freedom", 5 / 3) for name in FITS]


CASE = Case("lmfit", AXES, 300, simulate, lambda draws: rows(draws, False), lambda draws: rows(draws, True), second)

if __name__ == "__main__":
    CASE.main()
