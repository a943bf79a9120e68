"""
Test
====

Text.
"""
import matplotlib.pyplot as plt
figure, axes = plt.subplots()
axes.plot([1,2])
