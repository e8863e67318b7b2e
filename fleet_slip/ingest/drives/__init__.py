"""From the rows of a log to drives of counts at 100 Hz, and what is refused on the way."""
