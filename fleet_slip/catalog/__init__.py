"""What is measured: signals, features and feature sets, and the integer SQL that both become."""
