"""Device drivers, one file per chip or camera."""
