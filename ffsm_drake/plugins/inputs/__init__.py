"""What a run was made from, kept in its folder: models, plans, policies, user-supplied modules."""
