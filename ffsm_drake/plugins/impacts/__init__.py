"""A spinning target slowed by repeated impacts of two arms' tips, in a plane."""
