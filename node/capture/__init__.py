"""How a node takes its pictures: exposures, and the loop that locks them to the other node's lamps."""
