"""Parts that the kernels of several methods are made of: motion, sensors, landmarks, covariance updates."""
