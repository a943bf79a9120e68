"""Rendered stereo images, and the chain of Herath et al. (2007) fig. 3 that makes observations of them.

Only the stages and the chain need OpenCV, the extra ``vision``.
"""

from consistency.referee.extras import explained_import

with explained_import(__name__):
    from consistency.stereo.rendered_images.chain import (
        Biases,
        Chain,
        Growth,
        Stops,
        TrackMeans,
        Tracks,
        bias_map,
        disparity_growth,
        stand,
        track_means,
    )
    from consistency.stereo.rendered_images.scene import Camera, Lens, StereoCamera

__all__ = [
    "Biases",
    "Camera",
    "Chain",
    "Growth",
    "Lens",
    "StereoCamera",
    "Stops",
    "TrackMeans",
    "Tracks",
    "bias_map",
    "disparity_growth",
    "stand",
    "track_means",
]
