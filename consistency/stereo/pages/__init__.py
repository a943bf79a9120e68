"""Sections and documents of reports on images and stereo sensors."""
