"""What other programs read: files of a recorded run."""
