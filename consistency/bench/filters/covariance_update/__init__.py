"""How the covariance is kept up to date: all of it in each step, or the active part alone."""
