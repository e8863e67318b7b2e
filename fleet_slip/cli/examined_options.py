"""What a command examines: a published model, or signals that are named."""

from collections.abc import Sequence
from typing import Annotated

import typer

from fleet_slip.errors import UsageError

Model = Annotated[
    str | None,
    typer.Argument(
        help="NAME, NAME@VERSION or NAME@ALIAS of a published model. Default: the only one that "
        "there is, unless --signals is given.",
        show_default=False,
    ),
]
Signals = Annotated[
    str | None,
    typer.Option(
        help="Instead of a published model: signals to fit, separated by commas; 'catalogue' is "
        "all inputs."
    ),
]
FeatureSetOption = Annotated[
    str | None,
    typer.Option(
        "--features", help="Feature set that --signals are of. Default: the logged signals."
    ),
]


def quantities(values: Sequence[str] | None, option: str) -> dict[str, float]:
    """Return what options like `--noise ay=0.2` say, in SI units. Raises `UsageError`."""
    found = {}
    for value in values or ():
        name, _, number = value.partition("=")
        try:
            found[name.strip()] = float(number)
        except ValueError:
            raise UsageError(
                f"{option} {value}: write SIGNAL=NUMBER in SI units, such as ay=0.2."
            ) from None
    return found
