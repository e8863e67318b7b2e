"""How the sensors of cars are off, from the Gram rows of their drives."""
