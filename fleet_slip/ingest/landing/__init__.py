"""How drives land in the warehouse, once."""
