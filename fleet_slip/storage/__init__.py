"""Where tables and documents lie: folders, object stores, Delta tables, runs."""
