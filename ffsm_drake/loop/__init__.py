"""The closed loop: which blocks there are, and how they are wired into one Diagram."""
