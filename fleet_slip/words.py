"""How messages say numbers with their nouns, and names from strangers."""


def number_of(number: int, noun: str) -> str:
    """Return a number of things, such as `1 drive` or `1,500 Gram rows`."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def shown(text: object) -> str:
    """Return a name as it can stand in a one-line message, whatever characters it has."""
    plain = str(text)
    return plain if plain.isprintable() else repr(plain)
