"""What the cases of GTSAM's IMU share: a motion, its samples with noise, and the error of the factor at the truth."""

import gtsam
import numpy as np

STEPS, DT = 150, 0.01  # s
GYRO, ACCELEROMETER = 0.01, 0.02  # densities of the noise: rad/s and m/s^2, each / sqrt(Hz)
START = gtsam.NavState(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3), np.zeros(3), np.array([1.0, 0.0, 0.0]))
BIAS = gtsam.imuBias.ConstantBias()
WALKS = 0.01, 0.003  # of the biases of both, where they walk: m/s^2 and rad/s, each * sqrt(Hz)
PARAMS = gtsam.PreintegrationParams.MakeSharedU(9.81)
COMBINED = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)
for params in (PARAMS, COMBINED):
    params.setGyroscopeCovariance(GYRO**2 * np.eye(3))
    params.setAccelerometerCovariance(ACCELEROMETER**2 * np.eye(3))
    params.setIntegrationCovariance(1e-12 * np.eye(3))
COMBINED.setBiasAccCovariance(WALKS[0] ** 2 * np.eye(3))
COMBINED.setBiasOmegaCovariance(WALKS[1] ** 2 * np.eye(3))
if hasattr(COMBINED, "setBiasAccOmegaInit"):  # until 4.2: of the first bias, which is known here
    COMBINED.setBiasAccOmegaInit(1e-12 * np.eye(6))


def preintegrated(acceleration, rate):
    return integrated(gtsam.PreintegratedImuMeasurements(PARAMS, BIAS), acceleration, rate)


def combined(acceleration, rate):
    return integrated(gtsam.PreintegratedCombinedMeasurements(COMBINED, BIAS), acceleration, rate)


def integrated(measurements, acceleration, rate):
    for a, w in zip(acceleration, rate, strict=True):
        measurements.integrateMeasurement(a, w, DT)
    return measurements


def noise(rng):
    return [rng.normal(0, density / DT**0.5, (STEPS, 3)) for density in (ACCELEROMETER, GYRO)]


def motion(turn):
    """Signals without noise, what they are summed up to, and the states that this is the truth of."""
    t = DT * np.arange(STEPS)
    acceleration = np.column_stack([2 * np.cos(2 * t), 1.5 * np.sin(3 * t), 9.81 + np.cos(t)])
    rate = turn * np.column_stack([0.4 * np.cos(t), 0.8 * np.sin(2 * t), np.full(STEPS, 1.2)])
    end = preintegrated(acceleration, rate).predict(START, BIAS)  # of the library: no error of discretisation
    return acceleration, rate, (START.pose(), START.velocity(), end.pose(), end.velocity(), BIAS)


def factor(measured, truth):
    """Residual at the truth, and the covariance by which the factor weighs it, which has a name since 4.3.0."""
    residual = gtsam.ImuFactor(*range(5), measured).evaluateError(*truth)
    return residual, getattr(measured, "residualCovariance", measured.preintMeasCov)()
