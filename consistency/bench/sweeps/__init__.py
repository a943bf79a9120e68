"""Many scenarios at once: a grid of worlds, each judged until decided, and what the map of them says of one rig.

``axes`` says what an axis of the grid changes, ``plan`` reads a sweep's file and expands its grid, ``cell`` runs one
filter in one cell, ``folder`` keeps the cells and goes on where it was stopped, ``regime`` is the map; ``rig`` finds a
rig's place in it, and ``recommend`` what to trust there. Nothing here draws; the report of a map is in ``reporting``.
"""
