"""An external controller over UDP: each sample sends the inputs and receives the force."""
