"""Parts that the kernels of several methods are made of: sensors, landmarks, covariance updates."""
