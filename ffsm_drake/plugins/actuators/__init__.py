"""Actuators: limits, drives, wheels, thrusters and their plumes."""
