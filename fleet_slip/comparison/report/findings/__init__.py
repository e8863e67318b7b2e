"""What a report knows: gathered from the warehouse, the registry and a kept evaluation."""
