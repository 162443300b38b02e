"""A trained policy in an ONNX file as a control law."""
