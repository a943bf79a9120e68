"""Where a cart is: an extended Kalman filter, and a simulated world to try it in."""
