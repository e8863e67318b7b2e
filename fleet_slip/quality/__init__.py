"""Checks for faulty sensors and labels: of rows, of a drive, of its peers, of its label."""
