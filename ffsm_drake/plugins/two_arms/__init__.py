"""Two arms that hold one target: the closed chain, laws in it, and its internal force."""
