"""The checks before a dive: gather facts about machine, bus and devices, and judge them."""
