"""Live in the browser: runs to watch or under an operator's panel, and the replay of a record."""
