"""Many scenarios at once: a grid of worlds, each judged until decided, and the map of them.

``sweep_file`` says what an axis of the grid changes, reads a sweep's file and expands its grid; ``run_sweep`` runs the
cells that are missing, one filter in one cell at a time, and keeps them; ``regime_map`` is the map.
Nothing here draws; the report of a map is in ``pages``.
"""
