"""Studies of the package itself: the paper's section IV, what each effect costs, what accuracy
costs.

Users of all that lies above; nothing but the commands imports them.
"""
