"""Reference implementations of the filters: each method as a textbook writes it, dense and in plain NumPy.

A module is a method; ``basics``, ``inverse_range`` and ``robocentric_state`` have what several share. The filters of
``methods`` are tested against these, which also do their single steps. No kernel reads anything here, and nothing here
imports ``methods`` or ``kernel``.
"""
