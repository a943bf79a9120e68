"""Statistics of filter consistency: arrays in, records out; needs numpy and scipy only.

Tables, plots and files do not belong here.
"""
