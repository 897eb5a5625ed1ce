"""Calibration of a node's camera, lights and magnetometer: the fits, and the checks that refuse poor ones."""
