"""From pose and landmark through the mounted sensor to the observation, and back: what all filters do alike."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.part_functions import (
    Slam,
    Triple,
    expands,
    insert,
    landmark_point,
    locate,
    locate_jacobian,
    measure,
    measure_jacobian,
    observation_point,
    observed_width,
    stands_apart,
    to_body,
    to_body_jacobian,
)
from consistency.bench.filters.kernel.work_arrays import Work
from consistency.bench.filters.motion.unicycle import Frame, robot_frame
from consistency.bench.models import point
from consistency.referee.types import Array


@inner
def observe(slam: Slam, frame: Frame, values: Array, z: Array) -> None:
    """z (s,) <- h: the landmark ``values`` (w,) as the sensor of a robot at ``frame`` sees it."""
    bx, by, bz = to_body(slam.landmark, frame, values)
    cx, cy, cz = point.to_sensor(bx, by, bz, slam.sensor.mount)
    expected = measure(slam.sensor, cx, cy, cz)
    for i in range(observed_width(slam.sensor)):
        z[i] = expected[i]


@inner
def linearise_at(slam: Slam, frame: Frame, values: Array, z: Array, Hp: Array, Hl: Array) -> None:
    """z (s,), Hp (s, 3), Hl (s, w) <- h at ``frame`` and ``values`` (w,), and its Jacobians by variables of both."""
    body = to_body(slam.landmark, frame, values)
    mount = slam.sensor.mount
    cx, cy, cz = point.to_sensor(body[0], body[1], body[2], mount)
    expected = measure(slam.sensor, cx, cy, cz)
    for i in range(observed_width(slam.sensor)):
        z[i] = expected[i]
    J = measure_jacobian(slam.sensor, cx, cy, cz)
    for i in range(observed_width(slam.sensor)):
        j0, j1, j2 = J[3 * i], J[3 * i + 1], J[3 * i + 2]
        row: Triple = (
            j0 * mount.xx + j1 * mount.xy + j2 * mount.xz,
            j0 * mount.yx + j1 * mount.yy + j2 * mount.yz,
            j0 * mount.zx + j1 * mount.zy + j2 * mount.zz,
        )
        to_body_jacobian(slam.landmark, frame, values, body, row, Hp[i], Hl[i])


@inner
def linearise(
    slam: Slam, pose: Array, values: Array, k: int, label: int, z: Array, Hp: Array, Hl: Array, work: Work[NamedTuple]
) -> None:
    """z (s,) <- h expected of pose (3,), values (w,) in step k + 1; Hp (s, 3), Hl (s, w) <- Jacobians at the point."""
    at, landmark = observation_point(slam.point, pose, k), landmark_point(slam.point, values, label, work)
    linearise_at(slam, robot_frame(at), landmark, z, Hp, Hl)
    if expands(slam.point):
        for i in range(observed_width(slam.sensor)):
            for j in range(len(pose)):
                z[i] += Hp[i, j] * (pose[j] - at[j]) + Hl[i, j] * (values[j] - landmark[j])
    if stands_apart(slam.point):
        observe(slam, robot_frame(pose), values, z)


@inner
def place_observed(slam: Slam, pose: Array, z: Array, values: Array, work: Work[NamedTuple]) -> None:
    """values (w,), ``work.Jp`` (w, 3), ``work.Jz`` (w, s) <- inverse of h at ``pose`` (3,) for z (s,); Jacobians."""
    mount, Jb, s = slam.sensor.mount, work.Jb, observed_width(slam.sensor)
    cx, cy, cz = locate(slam.sensor, z)
    body = point.from_sensor(cx, cy, cz, mount)
    J = locate_jacobian(slam.sensor, z)
    for j in range(s):
        Jb[0, j] = mount.xx * J[j] + mount.xy * J[s + j] + mount.xz * J[2 * s + j]
        Jb[1, j] = mount.yx * J[j] + mount.yy * J[s + j] + mount.yz * J[2 * s + j]
        Jb[2, j] = mount.zx * J[j] + mount.zy * J[s + j] + mount.zz * J[2 * s + j]
    insert(slam.landmark, robot_frame(pose), body, Jb, mount, values, work.Jp, work.Jz)
