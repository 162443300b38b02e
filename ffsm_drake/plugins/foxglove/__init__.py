"""A run live in Foxglove."""
