"""Where measured logs lie: which files there are, and copies of them on this machine."""
