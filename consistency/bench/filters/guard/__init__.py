"""Guards: which observations a filter is given. ``plain_rules`` has the kinds, and what a guard of each decides."""
