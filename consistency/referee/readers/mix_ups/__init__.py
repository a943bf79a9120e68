"""Hints on mix-ups in files whose errors are impossible."""
