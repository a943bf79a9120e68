"""Guards: which observations a filter is given. The kinds are in ``settings``, what a guard decides in ``deciding``."""
