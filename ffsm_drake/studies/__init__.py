"""Studies made of many runs: the paper's reproduction."""
