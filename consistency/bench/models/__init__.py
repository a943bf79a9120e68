"""Motion and observation models f, h and their Jacobians.

Noise-free pure functions of components: each takes and returns plain numbers or equally shaped
NumPy arrays (complex ones too, which the complex-step tests use), and can be called from a compiled
kernel. No randomness, no filter and no scenario belongs here.
"""
