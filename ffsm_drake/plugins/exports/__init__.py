"""Export of runs as CSV, MAT, MCAP, CCSDS or Parquet, and of scenarios as FMUs; live Foxglove."""
