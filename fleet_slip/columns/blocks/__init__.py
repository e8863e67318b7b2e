"""The columns of one drive in blocks of rows: a program of vector operations, compiled."""
