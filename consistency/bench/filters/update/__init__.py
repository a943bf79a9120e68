"""How a Gaussian goes through f and h and is corrected by what was observed.

An update predicts the covariance of the observations, decides how often to linearise, and corrects the state with
the gain that ``update_steps`` has in common for all.
"""
