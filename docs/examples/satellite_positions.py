"""Estimates with covariances of a public data set: positions by satellite on the Potsdamer Platz, Berlin (smartLoc).

    python docs/examples/satellite_positions.py DIR    # the folder datasets/smartLoc of libRSF

Writes est.csv and truth.csv. Each position is the weighted least squares of the pseudoranges of one time, with the
variances that the receiver states, and its covariance is the one that follows from these. DIR holds
Berlin_Potsdamer_Platz_Input.txt and _GT.txt, as github.com/TUC-ProAut/libRSF has them (CC BY-SA 4.0).
"""

import sys
from pathlib import Path

import numpy as np

NAME = "Berlin_Potsdamer_Platz"
FEWEST = 5  # satellites
ROUNDS = 8  # of Gauss and Newton
TURN = 7.2921151467e-5 / 299792458.0  # of the earth, rad in the time that light takes for a metre
FLATTENED = 1.0 - 0.00669438  # squared ratio of the axes of the ellipsoid
HEAD = "t,east,north,up,P_east_east,P_east_north,P_east_up,P_north_north,P_north_up,P_up_up,satellites"


def rows_of(path, kind):
    """Numbers of the lines of one kind of measurement, (N, columns)."""
    if not path.is_file():
        sys.exit(f"{path}: no such file; DIR must be the folder datasets/smartLoc of libRSF")
    lines = [line.split() for line in path.read_text().splitlines()]
    return np.array([line[1:] for line in lines if line[0] == kind], float)


def local_axes(origin):
    """East, north and up at a point of the earth, rows of (3, 3)."""
    x, y, z = origin
    longitude, latitude = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y) * FLATTENED)
    (s, c), (sl, cl) = ((np.sin(angle), np.cos(angle)) for angle in (latitude, longitude))
    return np.array([[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])


def position_of(ranges, start):
    """Position and clock error (4,) with their covariance (4, 4), from rows of range, variance, x, y, z."""
    measured, variance, satellites = ranges[:, 0], ranges[:, 1], ranges[:, 2:5]
    x = np.append(start, 0.0)
    for _ in range(ROUNDS):
        to = satellites - x[:3]
        distance = np.linalg.norm(to, axis=1)
        turned = TURN * (satellites[:, 0] * x[1] - satellites[:, 1] * x[0])  # by the earth while the signal travels
        H = np.column_stack([-to / distance[:, None], np.ones(len(to))])
        information = H.T @ (H / variance[:, None])
        x = x + np.linalg.solve(information, H.T @ ((measured - distance - turned - x[3]) / variance))
    return x, np.linalg.inv(information)


def main(folder):
    ranges = rows_of(folder / f"{NAME}_Input.txt", "pseudorange3")
    truth = rows_of(folder / f"{NAME}_GT.txt", "point3")[:, :4]
    origin = truth[0, 1:]
    E = local_axes(origin)
    estimates, true = [], []
    for t in np.unique(ranges[:, 0]):
        some = ranges[ranges[:, 0] == t, 1:]
        if len(some) < FEWEST:
            continue
        x, C = position_of(some, origin)
        P = E @ C[:3, :3] @ E.T
        estimates.append([t, *E @ (x[:3] - origin), *P[np.triu_indices(3)], len(some)])
        true.append([t, *E @ (truth[np.argmin(np.abs(truth[:, 0] - t)), 1:] - origin)])
    np.savetxt("est.csv", estimates, "%.12g", ",", header=HEAD, comments="")
    np.savetxt("truth.csv", true, "%.12g", ",", header="t,east,north,up", comments="")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
