"""A stereo sensor, measured: noise, growth with disparity, bias map, tails and whiteness, each with an interval.

``coordinate_fit`` has the model of one coordinate, its estimates and the shape of its noise; ``characterise`` makes
arrays of a log and puts the coordinates together, ``sensor_text`` says them.
docs/characterise.md has the method.
"""
