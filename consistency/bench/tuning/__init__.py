"""Which noises should a filter believe in? Fitted on some runs, and judged on others that the fit has not seen.

``groups`` says what a factor scales, ``scores`` scores the steps of a run, ``bench`` all runs at one setting, ``fit``
finds the best setting with its intervals and knows no filter. ``parts`` divides a scenario or a log into what is fitted
and what is judged, ``why`` asks what no setting can mend, ``tune`` puts them together, ``result`` says
in words what comes of it, and ``writing`` in files.
"""
