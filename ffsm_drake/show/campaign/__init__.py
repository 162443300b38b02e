"""A campaign's page and charts."""
