"""The record that every job leaves: what ran, when, and how it ended."""
