"""Whole simulations in machine code: sensing, law, limits, plant and integrator, traced once.

case, run (blocks and numbers of a run) -> blocks (what the code depends on, layout of the cells)
-> sampling, forces, instant, marching (the loop on symbols) -> functions, code, module_text (LLVM
text) -> compiling -> kernel (a call runs a phase of several runs) -> missions (phases, in stages)
-> engine (compared with Drake before the first use)
"""
