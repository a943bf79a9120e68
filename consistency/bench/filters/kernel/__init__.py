"""What compiled filters share: dispatch on parts, linear algebra, work arrays, the loop over a trial.

Nothing here knows a motion, a sensor, a landmark or an update; those are parts, in the folders beside.
"""
