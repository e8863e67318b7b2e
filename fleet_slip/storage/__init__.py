"""Storage of tables and documents: folders, object stores, Delta tables, runs."""
