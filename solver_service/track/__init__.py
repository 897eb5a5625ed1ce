"""The track of one pair over time: one estimate from every light and every sensor (docs/track.md)."""
