"""A noise model for odometry that states no covariance: fitted at one span, and judged on drives that chose nothing."""
