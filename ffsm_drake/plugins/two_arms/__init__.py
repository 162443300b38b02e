"""Two arms on one target: the closed chain, its internal force, and the laws in it."""
