"""Laws and references for a frame, and for undriven coordinates."""
