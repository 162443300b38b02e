"""Optimal motions to rest within every limit, and the TVLQR law that tracks them."""
