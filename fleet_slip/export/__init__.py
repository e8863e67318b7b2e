"""A published version as an integer program, and that program in other languages."""
