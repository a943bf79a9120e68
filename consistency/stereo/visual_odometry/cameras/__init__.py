"""Calibrated cameras and the files that they are read from."""
