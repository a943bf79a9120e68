"""Which noises should a filter believe in? Fitted on some runs, and judged on others that the fit has not seen.

``noise_groups`` says what a factor scales, ``scores`` scores all runs at one setting, ``fit`` finds the best setting
with its intervals and knows no filter. ``split`` divides a scenario or a log into what is fitted and what is judged,
``faults`` asks what no setting can mend, ``tune`` puts them together, and ``result`` says in words and files what comes
of it.
"""
