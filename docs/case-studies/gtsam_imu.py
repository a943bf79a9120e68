"""Has the error of GTSAM's IMU factor the covariance that the factor states? Writes archives for `consistency analyse`.

Runs in an environment with the core and any gtsam; 4.2.1 needs NumPy < 2. docs/case-studies.md says what is shown.
"""

from importlib.metadata import version
from pathlib import Path

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

import consistency as cs

DRAWS, STEPS, DT = 200, 150, 0.01  # s
GYRO, ACCELEROMETER = 0.01, 0.02  # densities of the noise: rad/s and m/s^2, each / sqrt(Hz)
AXES = [f"{name} {axis}" for name in ("rotation", "position", "velocity") for axis in "xyz"]
START = gtsam.NavState(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3), np.zeros(3), np.array([1.0, 0.0, 0.0]))
BIAS = gtsam.imuBias.ConstantBias()
PARAMS = gtsam.PreintegrationParams.MakeSharedU(9.81)
PARAMS.setGyroscopeCovariance(GYRO**2 * np.eye(3))
PARAMS.setAccelerometerCovariance(ACCELEROMETER**2 * np.eye(3))
PARAMS.setIntegrationCovariance(1e-12 * np.eye(3))


def preintegrated(acceleration, rate):
    measurements = gtsam.PreintegratedImuMeasurements(PARAMS, BIAS)
    for a, w in zip(acceleration, rate, strict=True):
        measurements.integrateMeasurement(a, w, DT)
    return measurements


def study(turn, rng, draws=DRAWS):
    """Residual and preintegrated vector of each draw: errors (draws, 1, 9) and covariances, by name."""
    t = DT * np.arange(STEPS)
    acceleration = np.column_stack([2 * np.cos(2 * t), 1.5 * np.sin(3 * t), 9.81 + np.cos(t)])
    rate = turn * np.column_stack([0.4 * np.cos(t), 0.8 * np.sin(2 * t), np.full(STEPS, 1.2)])
    exact = preintegrated(acceleration, rate)  # without noise: the truth has no error of discretisation
    end = exact.predict(START, BIAS)
    truth = START.pose(), START.velocity(), end.pose(), end.velocity(), BIAS
    values = gtsam.Values()
    for key, value in zip((X(0), V(0), X(1), V(1), B(0)), truth, strict=True):
        values.insert(key, value)
    rows = []
    for _ in range(draws):
        noise_a, noise_w = (rng.normal(0, density / DT**0.5, (STEPS, 3)) for density in (ACCELEROMETER, GYRO))
        measured = preintegrated(acceleration + noise_a, rate + noise_w)
        factor = gtsam.ImuFactor(X(0), V(0), X(1), V(1), B(0), measured)
        residual, raw = factor.evaluateError(*truth), measured.preintMeasCov()
        stated = getattr(measured, "residualCovariance", measured.preintMeasCov)()  # of the factor; new in 4.3.0
        assert np.isclose(cs.nees(residual, stated), 2 * factor.error(values))
        rows.append((residual, stated, exact.preintegrated() - measured.preintegrated(), raw))
    arrays = (np.array(column)[:, None] for column in zip(*rows, strict=True))
    return dict(zip(("residual", "stated", "vector", "raw"), arrays, strict=True))


if __name__ == "__main__":
    at = str(Path(__file__).with_name(f"gtsam-{version('gtsam')}"))
    full, tenth = (study(turn, np.random.default_rng(20070)) for turn in (1.0, 0.1))
    errors, covariances = np.float32(full["residual"]), np.float32(full["stated"])
    np.savez_compressed(f"{at}.npz", errors=errors, covariances=covariances, axes=AXES)
    np.savez_compressed(f"{at}-tenth.npz", nees=cs.nees(tenth["residual"], tenth["stated"]), dof=9)
    np.savez_compressed(f"{at}-vector.npz", nees=cs.nees(full["vector"], full["raw"]), dof=9)
    np.savez_compressed(f"{at}-raw.npz", nees=cs.nees(full["residual"], full["raw"]), dof=9)
