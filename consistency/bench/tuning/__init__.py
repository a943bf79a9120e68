"""Which noises should a filter believe in? Fitted on some runs, and judged on others that the fit has not seen.

``noise_groups`` says what a factor scales, ``innovation_likelihood`` scores all runs at one setting,
``noise_factor_fit`` finds the best setting and how well it is known. ``fit_and_verdict_trials`` divides a scenario or a
log into what is fitted and what is judged, ``tune`` puts them together, and ``tuning_result`` has the words and files.
"""
