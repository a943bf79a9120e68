"""How kernels are compiled by Numba, and where compiled code is kept."""
