"""Find the other node's lights in a picture."""
