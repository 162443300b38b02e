"""Code for numbers and arrays, traced: run once on symbols, it leaves a list of operations."""
