"""NEES, intervals, distributions and figures of merit."""
