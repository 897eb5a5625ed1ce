"""The node under water without a screen: one button, a status lamp, a buzzer, the dive lights, a leak probe."""
