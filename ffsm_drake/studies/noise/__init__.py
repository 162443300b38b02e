"""What sensor noise costs each controller."""
