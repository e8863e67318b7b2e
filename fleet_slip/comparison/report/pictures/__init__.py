"""Which figures a report has, with their captions."""
