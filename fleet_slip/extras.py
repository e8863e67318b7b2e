"""The optional parts of the package: what says which one to install, where one is missing."""

from collections.abc import Iterator
from contextlib import contextmanager

from fleet_slip.errors import ExtraError


@contextmanager
def needed(extra: str, purpose: str) -> Iterator[None]:
    """Import what an extra brings; raises `ExtraError` that says how to install it and what for."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package == "fleet_slip":
            raise
        raise missing(extra, purpose, package) from None


def missing(extra: str, purpose: str, package: str) -> ExtraError:
    """Return the error that says how to install an extra."""
    return ExtraError(
        f"{purpose} needs the package {package}, which is not installed. "
        f"Run: pip install 'fleet-slip[{extra}]'"
    )
