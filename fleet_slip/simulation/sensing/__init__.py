"""What sensors and satellite receivers make of the truth."""
