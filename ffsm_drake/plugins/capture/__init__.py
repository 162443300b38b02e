"""Capture of a moving target by approach, grasp and closing gripper; supervisor of a mission."""
