"""Gram matrices and their exact solution, rounded once."""
