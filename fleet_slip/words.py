"""Numbers with their nouns, as they are said."""


def number_of(number: int, noun: str) -> str:
    """Return a number of things, such as `1 drive` or `1,500 Gram rows`."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
