"""The bench: worlds, filters and Monte Carlo studies, judged by the referee. It does not know the stereo laboratory."""
