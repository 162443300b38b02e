"""Control laws: the paper's four, task-space laws, and two published ways to detumble."""
