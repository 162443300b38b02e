"""Whole simulations in machine code: sensing, law, limits, plant and integrator, traced once.

parameters (what differs between runs) -> loop (the blocks, traced on symbols) -> kernel (one call
runs as many simulations as a register holds) -> dynamics (compared with Drake before the first use)
"""
