"""Power and heat: the firmware's bits, the temperature, the battery, and a load that is lowered in time."""
