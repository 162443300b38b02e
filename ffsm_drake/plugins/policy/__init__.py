"""Laws that act as an agent does, and a trained policy in an ONNX file as a law."""
