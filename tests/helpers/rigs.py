"""A small stereo rig with a turned right camera, near that of Valencia & Andrade-Cetto (2018), and a motion."""

import numpy as np

from consistency.referee.geometry import rotation
from consistency.vision import RelativePose, StereoRig

K = np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
RIG = StereoRig(K, K, rotation(0.04, 0.016, 0.014), [0.385, 0.007, 0.0], (640, 480))
MOTION = RelativePose.from_vector(np.array([0.3, -0.2, 0.9, 0.04, -0.03, 0.2]))
