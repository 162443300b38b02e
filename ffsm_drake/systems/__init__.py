"""The blocks of the closed loop's diagram: reference, sensing, controllers, actuation, forces."""
