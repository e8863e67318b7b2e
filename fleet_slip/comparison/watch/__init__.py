"""A drive to look at: as a page that plays, and as a film."""
