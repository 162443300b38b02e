"""A first scenario from a URDF: the command new."""
