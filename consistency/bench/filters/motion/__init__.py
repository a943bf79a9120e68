"""How the robot moves: f, its Jacobian and its noise, one file for each motion model."""
