"""A check of the installation."""
