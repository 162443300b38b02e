"""Equations of one spacecraft as machine code, for many runs at once.

tree (read from Drake's plant) -> equations, traced on symbols -> LLVM IR on whole registers ->
compiled code, kept on disk -> kernels, compared with Drake -> plant and models of several copies.
"""
