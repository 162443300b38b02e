"""Analysis and design before a run: stability of the sampled loop, gains, a first motion and
scenario.
"""
