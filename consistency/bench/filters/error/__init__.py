"""In which error the covariance is meant: retraction, and the noise of motion in that error."""
