"""An external controller over UDP: the simulation asks, the controller answers."""
