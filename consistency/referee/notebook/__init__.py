"""Files of another estimator in three lines of Python: read, judge, look."""
