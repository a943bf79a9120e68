"""Where is a filter most overconfident? A search over worlds, and one test on fresh trials of what it comes up with.

``world_space`` has the dimensions of worlds and turns a point into a scenario, ``world_scores`` scores a filter in
worlds. ``worst_point_search`` looks for the worst world, and knows nothing of filters.
``challenge`` puts them together, confirms, and has the words and files.
"""
