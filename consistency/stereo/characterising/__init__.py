"""A stereo sensor, measured: noise, growth with disparity, bias map, tails and whiteness, each with an interval.

``residuals`` makes arrays of a log, ``likelihood`` is the model of one coordinate and ``coordinate_fit`` its estimates,
``tails`` the shape; ``characterise`` puts them together, ``wording`` and ``writing`` say them. docs/characterise.md has
the method.
"""
