"""The stereo front-end: from matches or images to a relative pose with its covariance.

Only :func:`relative_motion` and what else works on images needs OpenCV, the extra ``vision``.
"""

from consistency.referee.extras import lazy_names

# the names stand in __init__.pyi; each is loaded on first use, so that matches are registered without OpenCV
__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
