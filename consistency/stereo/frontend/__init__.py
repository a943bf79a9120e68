"""Stereo images to a log that filters run on, and to a trajectory with covariance."""

from consistency.stereo.frontend.images_to_log import FrontendOptions, Summary, write_frontend_log

__all__ = ["FrontendOptions", "Summary", "write_frontend_log"]
