"""The stereo front-end: from matches or images to a relative pose with its covariance."""
