"""C99 of a program: its names, state, steps and checks, and what counts Gram rows in a car."""
