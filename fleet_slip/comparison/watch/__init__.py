"""A drive to look at: as a page that plays."""
