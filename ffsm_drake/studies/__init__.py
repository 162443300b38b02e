"""Studies made of many runs: the paper's reproduction, and what noise costs."""
