"""What compiled filters share: dispatch on parts, linear algebra, scratch arrays, motion, the loop over a trial.

Nothing here knows a sensor, a landmark or an update; those are parts, in ``parts`` and ``methods``.
"""
