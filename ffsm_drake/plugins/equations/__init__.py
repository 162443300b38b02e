"""Equations of motion of one spacecraft, on numbers or on symbols.

tree (read from Drake's plant) -> equations -> comparison with the plant, in random states
"""
