"""A truth that is fitted to the estimates, has a covariance of its own, or shares errors with all of them."""
