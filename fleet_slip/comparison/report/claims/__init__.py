"""The paper's claims as a table, and how each is judged by the report's data."""
