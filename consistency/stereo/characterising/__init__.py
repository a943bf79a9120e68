"""A stereo sensor, measured: noise, growth with disparity, bias map, tails and whiteness, each with an interval.

``truth_residuals`` makes arrays of a log, ``likelihood`` is the model of one coordinate, and ``coordinate_fit`` has its
estimates and the shape of its noise; ``characterise`` puts them together, ``sensor_text`` says them.
docs/characterise.md has the method.
"""
