"""The tables of a data root, and DuckDB over them."""
