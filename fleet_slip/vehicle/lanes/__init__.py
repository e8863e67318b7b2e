"""Many drives at once: each is a lane of a compiled loop."""
