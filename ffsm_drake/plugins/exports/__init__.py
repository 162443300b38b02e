"""Export of runs as CSV, MAT, MCAP, CCSDS or Parquet; live Foxglove."""
