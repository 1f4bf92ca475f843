"""Studies of the package itself: section IV of the paper, cost of each effect, cost of accuracy.

They may import every other package except the commands; only the commands import them.
"""
