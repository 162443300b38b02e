"""Parts: components of the closed loop, and what records and reports read of them."""
