"""Running a scenario: the rollout, its monitor, the record and its metrics."""
