"""Forces of the orbit."""
