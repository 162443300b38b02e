"""Laws and motions for the pose of a frame, and motions with undriven coordinates."""
