"""Is the deviation of scikit-learn's Gaussian process that of a new target, where the noise is told as alpha?"""

import numpy as np
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, WhiteKernel
from study import Argument, Case

X, NEW, NOISE = np.linspace(0, 5, 20)[:, None], np.array([[2.6]]), 0.1  # variance
KERNEL = RBF(1.0)
FITS = {
    "alpha, new target": ({"kernel": KERNEL, "alpha": NOISE}, True),
    "alpha, value of the function": ({"kernel": KERNEL, "alpha": NOISE}, False),
    "WhiteKernel, new target": ({"kernel": KERNEL + WhiteKernel(NOISE)}, True),
}


def simulate(rng, runs):
    """Values of the function and targets, at the places of X and at the new one."""
    places = np.vstack([X, NEW])
    f = rng.multivariate_normal(np.zeros(len(places)), KERNEL(places) + 1e-10 * np.eye(len(places)), runs)
    return f, f + rng.normal(0, NOISE**0.5, f.shape)


def rows(data, names):
    f, y = data
    out = {}
    for name in names:
        how, target = FITS[name]
        errors, variances = [], []
        for function, targets in zip(f, y, strict=True):
            gpr = GaussianProcessRegressor(optimizer=None, **how).fit(X, targets[:-1])
            mean, deviation = gpr.predict(NEW, return_std=True)
            errors.append((targets if target else function)[-1] - mean)
            variances.append(deviation**2)
        out[name] = np.array(errors), np.array(variances)[..., None]
    return out


def second():
    K, k = KERNEL(X) + NOISE * np.eye(len(X)), KERNEL(X, NEW)
    variance = (1 - k.T @ np.linalg.solve(K, k)).item()
    text = "variance of function and noise over that of the function"
    return [Argument("alpha, new target", text, (variance + NOISE) / variance)]


CASE = Case("scikit-learn", ("target",), 234, simulate, lambda data: rows(data, list(FITS)[:1]),
            lambda data: rows(data, list(FITS)[1:]), second)  # fmt: skip

if __name__ == "__main__":
    CASE.main()
