"""Stage 4 of Herath et al. (2007) fig. 3: where the features of one image are in the next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from consistency.referee.types import Array
from consistency.stereo.rendered_images.selection import from_columns, require_size, to_columns
from consistency.stereo.visual_odometry.features import opencv

STEPS, SMALL = 40, 0.003  # iterations of Lucas & Kanade at most; px of a step that ends them


class Tracking(Protocol):
    """Follows features from one left image to the next."""

    def follow(self, before: Array, after: Array, uv: Array, true: Array) -> tuple[Array, Array]:
        """Where features are in ``after``.

        Parameters
        ----------
        before, after : 8-bit images (h, w)
        uv : (N, 2), px from the middle, in ``before``
        true : (N, 2), where the features really are in ``after``: for a stage that makes no error

        Returns
        -------
        uv : (N, 2)
        found : (N,), bool
        """


@dataclass(frozen=True)
class KnownProjection:
    """No tracker: each feature is where its point is projected."""

    def follow(self, before: Array, after: Array, uv: Array, true: Array) -> tuple[Array, Array]:
        return true, np.ones(len(uv), bool)


@dataclass(frozen=True)
class Klt:
    """Lucas & Kanade (1981) on a pyramid, translation alone; ``agreement`` px between there and back again, or None."""

    window: int = 15  # px
    levels: int = 3
    agreement: float | None = None

    def follow(self, before: Array, after: Array, uv: Array, true: Array) -> tuple[Array, Array]:
        require_size(before, self.window + 2, f"the tracker's window of {self.window} px")
        there, found = self.flow(before, after, uv)
        if self.agreement is not None:
            back, again = self.flow(after, before, there)
            found &= again & (np.hypot(*(back - uv).T) <= self.agreement)
        return there, found

    def flow(self, before: Array, after: Array, uv: Array) -> tuple[Array, Array]:
        if not len(uv):
            return uv, np.zeros(0, bool)
        cv2 = opencv()
        end = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, STEPS, SMALL)
        start = to_columns(before, uv).astype(np.float32)[:, None]
        place, found, _ = cv2.calcOpticalFlowPyrLK(
            before, after, start, None, winSize=(self.window, self.window), maxLevel=self.levels, criteria=end
        )
        return from_columns(after, place[:, 0].astype(float)), found[:, 0].astype(bool)
