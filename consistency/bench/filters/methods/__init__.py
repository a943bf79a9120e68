"""Filters: one file for each method, with the parts that it is made of and its plain NumPy twin."""
