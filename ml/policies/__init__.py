"""Policies: beta windows in, amplitude fractions out. The protocol, constants, proportional control, ONNX files."""
