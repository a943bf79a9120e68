"""Stereo images of a textured wall, rendered by its homographies, so that every motion is known exactly."""

import numpy as np

from consistency.vision import RelativePose, StereoRig

SIZE = (480, 320)  # px
F, BASELINE = 320.0, 0.2  # px, m
K = np.array([[F, 0.0, 240.0], [0.0, F, 160.0], [0.0, 0.0, 1.0]])
NORMAL, DEPTH = np.array([0.35, 0.1, 1.0]), 4.0  # of the wall: NORMAL . p = DEPTH in the world, m
TEXEL = 0.0125  # m, of the texture


def rig():
    """The rig that the images are of."""
    return StereoRig(K, K, np.eye(3), np.array([BASELINE, 0.0, 0.0]), SIZE)


def texture(rng, side=900):
    """Smooth noise of several sizes, (side, side), 8 bit."""
    import cv2

    out = np.zeros((side, side), np.float32)
    for blur in (1.5, 3.0, 6.0, 12.0):
        layer = cv2.GaussianBlur(rng.normal(size=(side, side)).astype(np.float32), (0, 0), blur)
        out += layer / layer.std()
    out = 128 + 45 * out / out.std()
    return np.clip(out, 0, 255).astype(np.uint8)


def pair(camera, wall):
    """Left and right image from the pose of the left camera in the world."""
    return tuple(_view(camera.compose(RelativePose(np.eye(3), np.array([b, 0.0, 0.0]))), wall) for b in (0.0, BASELINE))


def _view(camera, wall):
    """The wall is seen through x, y of the world: texture (i, j) stands at x = (j - side/2) TEXEL, y likewise."""
    import cv2

    half = len(wall) / 2
    a, b, c = NORMAL
    on_wall = np.array([[TEXEL, 0, -half * TEXEL], [0, TEXEL, -half * TEXEL], [0, 0, 1.0]])  # texel -> (x, y, 1)
    in_space = np.array([[1.0, 0, 0], [0, 1.0, 0], [-a / c, -b / c, DEPTH / c]])  # (x, y, 1) -> point
    world = camera.inverse()
    H = K @ (world.R @ in_space @ on_wall + np.outer(world.t, [0, 0, 1.0]))
    # finer, then averaged: SIFT would see the steps of a plain interpolation
    up = np.diag([3.0, 3.0, 1.0]) @ np.array([[1, 0, 1 / 3], [0, 1, 1 / 3], [0, 0, 1.0]])
    big = cv2.warpPerspective(wall, up @ H, (3 * SIZE[0], 3 * SIZE[1]), flags=cv2.INTER_CUBIC)
    return np.asarray(cv2.resize(big, SIZE, interpolation=cv2.INTER_AREA))


def drive(frames, step=0.1):
    """Poses of the left camera on a straight, slightly turning way towards the wall."""
    move = RelativePose.from_vector(np.array([0.01, 0.0, step, 0.0, 0.004, 0.0]))
    poses = [RelativePose(np.eye(3), np.zeros(3))]
    for _ in range(frames - 1):
        poses.append(poses[-1].compose(move))
    return poses


def write_kitti(folder, poses, wall):
    """The images, calib.txt, times.txt and poses.txt of a KITTI sequence."""
    import cv2

    for side in ("image_0", "image_1"):
        (folder / side).mkdir(parents=True)
    for k, pose in enumerate(poses):
        for side, image in zip(("image_0", "image_1"), pair(pose, wall), strict=True):
            assert cv2.imwrite(str(folder / side / f"{k:06d}.png"), image)
    rows = []
    for name, b in (("P0", 0.0), ("P1", BASELINE)):
        P = K @ np.column_stack([np.eye(3), [-b, 0.0, 0.0]])
        rows.append(f"{name}: " + " ".join(f"{x:.9e}" for x in P.ravel()))
    (folder / "calib.txt").write_text("\n".join(rows) + "\n")
    (folder / "times.txt").write_text("\n".join(f"{0.1 * k:.3f}" for k in range(len(poses))) + "\n")
    lines = (" ".join(f"{x:.9e}" for x in np.column_stack([p.R, p.t]).ravel()) for p in poses)
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")
