"""Flexible parts of the spacecraft: panels, beams, slosh, passive joints, gears."""
