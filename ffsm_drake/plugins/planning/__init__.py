"""Planning a motion to rest within every limit: the optimal control problem, its solution, and what
it leaves.
"""
