"""An external controller over UDP: inputs go out at every sample, the force comes back."""
