"""The commands that bring data in and show it."""
