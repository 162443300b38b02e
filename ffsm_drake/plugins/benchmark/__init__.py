"""A benchmark that ranks control laws on published missions, next to lower bounds."""
