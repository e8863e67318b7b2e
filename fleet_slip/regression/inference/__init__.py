"""How sure coefficients are, and what they rest on."""
