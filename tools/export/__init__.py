"""The commands and formats that give a dive to other programs."""
