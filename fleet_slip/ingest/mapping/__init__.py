"""What a mapping says of a log: columns, units, axes, vehicles."""
