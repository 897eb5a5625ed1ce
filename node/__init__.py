"""One node: capture, detect, publish and record."""
