"""Where is a filter most overconfident? A search over worlds, and one test on fresh trials of what it comes up with.

``world_space`` has the dimensions of worlds and turns a point into a scenario. ``challenge`` scores a filter in worlds,
looks for the worst one, confirms it, and has the words and files.
"""
