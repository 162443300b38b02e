"""A planar example in which two arms slow a spinning target by repeated impacts."""
