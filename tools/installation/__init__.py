"""Set up a machine: configurations, certificates, services, a Raspberry Pi and its card."""
