"""What live views of a run share: pages of one address only, and an operator's inputs."""
