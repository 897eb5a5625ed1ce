"""Calibration of a node's camera, lights and magnetometer: fits, and when to refuse them."""
