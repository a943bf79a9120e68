"""Many scenarios at once: a grid of worlds, each judged until decided, and the map of them.

``sweep_axes`` says what an axis of the grid changes, ``sweep_file`` reads a sweep's file and expands its grid,
``run_cell`` runs one filter in one cell, ``sweep_folder`` keeps the cells, ``run_sweep`` runs those that are missing,
and ``regime_map`` is the map.
Nothing here draws; the report of a map is in ``pages``.
"""
