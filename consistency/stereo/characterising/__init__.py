"""A stereo sensor, measured: noise, growth with disparity, bias map, tails and whiteness, each with an interval.

``residuals`` makes arrays of a log, ``basis`` the functions that a bias map and a growth consist of, ``likelihood`` is
the model of one coordinate and ``coordinate`` its estimates, ``tails`` the shape; ``characterise`` puts them together,
``writing`` and ``printing`` say them. docs/characterise.md has the method.
"""
