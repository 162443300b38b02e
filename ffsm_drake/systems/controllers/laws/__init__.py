"""The control laws of the core: the four of the paper, and two with the nominal model."""
