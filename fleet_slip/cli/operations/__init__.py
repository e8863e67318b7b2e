"""The commands of every night."""
