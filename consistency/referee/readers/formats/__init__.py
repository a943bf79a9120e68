"""Formats of files, each read in a module."""
