"""How far the estimates of two filters are apart."""

import numpy as np


def apart(a, b):
    """Largest difference of poses (m, rad), of covariances and of NIS relative to their size, and of log det S.

    Infinite where they took in other observations.
    """
    assert a.failure is None
    assert b.failure is None
    if not np.array_equal(a.nis_dof, b.nis_dof):
        return float("inf")
    size = np.maximum(np.abs(b.covariance).max(axis=(1, 2), keepdims=True), 1e-30)
    covariance = (np.abs(a.covariance - b.covariance) / size).max()
    nis = np.nanmax(np.abs(a.nis - b.nis) / np.maximum(b.nis, 1.0))
    return float(max(np.abs(a.pose - b.pose).max(), covariance, nis, np.nanmax(np.abs(a.log_det - b.log_det))))
