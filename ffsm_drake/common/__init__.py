"""What every room uses: errors, files written whole, workers, the lifetime of diagrams."""
