"""Forces in orbit: gravity gradient, tide and solar pressure."""
