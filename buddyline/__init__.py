"""Two underwater nodes look at each other's lights; a closed form gives their full relative pose."""
