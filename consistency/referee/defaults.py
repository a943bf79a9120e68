"""Default settings of a verdict; each number is defined only here."""

from __future__ import annotations

FALSE_ALARM = 0.05  # chance to find a fault in a right estimator
DETECT = 1.5  # ratio of true to stated covariance that must not go unseen
POWER = 0.95  # probability that it does not
CONFIDENCE = 0.95  # of intervals that are reported and not judged
GATE_FALSE_ALARM = 1e-3  # of a gate in a test suite, or of a monitor in service: it is asked again and again
NIS_TOLERANCE = 1.2  # scales of the NIS up to this ratio, or down to its inverse, raise no alarm
