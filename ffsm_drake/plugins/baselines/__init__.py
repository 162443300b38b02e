"""Control laws from the literature as baselines.

Each law is in one file, with its source."""
