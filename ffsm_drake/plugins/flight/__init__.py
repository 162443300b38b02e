"""The control law of a scenario as C code for a flight computer; law and plant as FMUs."""
