"""Code for numbers and arrays, traced: run once on symbols, it leaves a list of operations.

numbers (arithmetic of symbols) -> elements, functions (NumPy's) -> arrays (what NumPy hands over)
-> tangents (derivatives), programs (evaluation for many inputs at once)
"""
