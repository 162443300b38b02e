"""Dynamics generated for one spacecraft: its equations as machine code for many copies at once.

tree (read from Drake's plant) -> equations, traced on symbols -> LLVM IR on whole registers ->
compiled code, kept on disk -> kernels, compared with Drake -> plant and models of several copies.
"""
