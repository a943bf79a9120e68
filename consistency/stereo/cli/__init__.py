"""Commands of the stereo laboratory."""
