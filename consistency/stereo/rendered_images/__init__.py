"""Rendered stereo images, and the chain of Herath et al. (2007) fig. 3 that makes observations of them.

``scene`` makes image pairs; ``stages`` holds the stages, and ``chain`` runs them and turns their errors into the
tables of a sensor. Only the stages and the chain need OpenCV, the extra ``vision``.
"""
