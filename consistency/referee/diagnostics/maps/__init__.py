"""Maps: the NEES of landmarks, alone and together with the pose, and rejected observations."""
