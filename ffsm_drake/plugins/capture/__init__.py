"""Capture of a moving target: approach, grasp, closing gripper, supervisor."""
