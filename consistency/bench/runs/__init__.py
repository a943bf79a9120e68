"""Monte Carlo studies: filters on trials, in parallel, until decided, or for the scripts of ``experiments/``.

Here belong seeds, workers, resuming, and the gathering of outcomes. What a trial is comes from ``simulation``, what a
filter does from ``filters``; tables and folders are in ``store``.
"""
