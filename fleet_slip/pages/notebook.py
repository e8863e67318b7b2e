"""What a notebook shows of an answer: a table, with a bar in each row."""

from collections.abc import Sequence
from html import escape


def notebook_table(
    title: str, header: Sequence[str], rows: Sequence[Sequence[str]], sizes: Sequence[float]
) -> str:
    """Return HTML of rows of text, each with a bar as long as its size beside the largest."""
    largest = max((abs(size) for size in sizes), default=0.0) or 1.0
    names = "".join(f"<th>{escape(name)}</th>" for name in header)
    lines = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}<td>{_bar(size / largest)}</td>"
        "</tr>"
        for row, size in zip(rows, sizes, strict=True)
    )
    return (
        f"<table><caption>{escape(title)}</caption><thead><tr>{names}<th></th></tr></thead>"
        f"<tbody>{lines}</tbody></table>"
    )


def _bar(part: float) -> str:
    """Return a drawing of a share from -1 to 1, to the left or to the right of its middle."""
    length = 60 * abs(part)
    return (
        '<svg width="122" height="10" role="img" aria-hidden="true">'
        f'<rect x="{61 - (length if part < 0 else 0):.1f}" y="1" width="{length:.1f}" height="8" '
        'fill="#4269d0"/></svg>'
    )
