"""Limits and delays of actuators, joint drives, reaction wheels, thrusters and their plumes."""
