"""One figure a function: from a report's data to a matplotlib figure."""
