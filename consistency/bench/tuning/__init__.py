"""Which noises should a filter believe in? Fitted on some runs, and judged on others that the fit has not seen.

``noise_factor_fit`` says what a factor scales, scores all runs at one setting, and finds the best setting and how well
it is known. ``tune`` divides a scenario or a log into what is fitted and what is judged, and has the words and files.
"""
