"""Block diagrams of the closed loop, as Graphviz text and pictures."""
