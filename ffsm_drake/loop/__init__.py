"""The closed loop: its blocks, and their wiring into one Diagram."""
