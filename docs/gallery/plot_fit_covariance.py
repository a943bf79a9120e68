"""
Odometry without a covariance: errors, growth and ratios of a fitted one
========================================================================

Six drives of a wheel odometry that errs as white noise, fitted over 10 m: errors of motions with the ellipses of the
fit, the squared error over the span beside the model, and the ratio of true to stated covariance of each drive, by a
fit to the others. The headings of these drives drift, each at its own rate, so that longer spans have larger errors.
"""

import numpy as np

import consistency as cs

DRIVES, STEPS, STEP = 6, 3000, 0.5  # m
SIGMA = np.array([0.02, 0.01, 0.002])  # of a step: forward, left, turn
rng = np.random.default_rng(4)


def poses(motions):
    """Matrices of poses from motions forward, left, turn."""
    return cs.drive_of("", motions, motions, motions=True).estimate


drives = []
for k in range(DRIVES):
    true = np.column_stack([np.full(STEPS, STEP), np.zeros(STEPS), rng.normal(0, 0.05, STEPS)])
    drift = [0.0, 0.0, rng.normal(0, 3e-4)]  # rad a step, of this drive
    estimated = true + SIGMA * rng.normal(size=true.shape) + drift
    drives.append(cs.Drive(f"drive {k + 1}", np.arange(STEPS) * STEP, np.arange(STEPS), poses(estimated), poses(true)))

model = cs.fit_covariance(drives, span="10m", name="wheels")
figure = model.plot()
print(model)
print("\n".join(model.warnings))
