"""Runs of any program: N processes, each with a seed and a folder of its own, and the verdict on what they wrote.

Standard library and threads do the work. How files are read and judged does not belong here.
"""
