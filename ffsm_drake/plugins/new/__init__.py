"""A first scenario from your URDF (``ffsm new``)."""
