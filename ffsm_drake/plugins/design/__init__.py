"""Stability and margins of the sampled loop, the verdict before a run, design of gains."""
