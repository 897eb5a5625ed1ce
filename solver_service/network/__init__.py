"""The estimate of any number of nodes in one frame, from every light and every sensor (docs/network.md)."""
