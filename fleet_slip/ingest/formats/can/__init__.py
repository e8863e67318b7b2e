"""CAN traces: frames of one message at a time, and what a database of messages makes of them."""
