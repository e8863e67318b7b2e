"""Exports of published versions: an integer program, and that program in other languages."""
