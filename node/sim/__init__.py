"""The simulated twin of a node: world, camera, inertial and depth sensors."""
