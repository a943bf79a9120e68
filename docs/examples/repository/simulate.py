"""Write truth.csv and estimates.csv: 120 drives of the cart."""

import numpy as np

from cart.world import DT, STEPS, trials

RUNS = 120
UPPER = np.triu_indices(3)


def write(name, columns, *arrays):
    run, step = np.divmod(np.arange(RUNS * STEPS), STEPS)
    rows = np.column_stack([run, step + 1, (step + 1) * DT, *(array.reshape(RUNS * STEPS, -1) for array in arrays)])
    np.savetxt(name, rows, "%.9g", ",", header=f"run,step,t,{columns}", comments="")


if __name__ == "__main__":
    truth, estimates, covariances = trials(RUNS)
    write("truth.csv", "x,y,heading", truth)
    upper = covariances[:, :, UPPER[0], UPPER[1]]
    write("estimates.csv", "x,y,heading,P_xx,P_xy,P_xh,P_yy,P_yh,P_hh", estimates, upper)
