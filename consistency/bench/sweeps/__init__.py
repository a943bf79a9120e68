"""Many scenarios at once: a grid of worlds, each judged until decided, and the map of them.

``axes`` says what an axis of the grid changes, ``plan`` reads a sweep's file and expands its grid, ``cell`` runs one
filter in one cell, ``sweep_folder`` keeps the cells, ``running`` does those that are missing, and ``regime`` is the
map.
Nothing here draws; the report of a map is in ``pages``.
"""
