"""Side-slip angle estimation from fleet logs."""
