"""Texts and numbers that stand in a mapping."""

from typing import Annotated

from pydantic import AfterValidator, Field, StringConstraints


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("has characters that cannot be printed")
    return text


Name = Annotated[str, StringConstraints(min_length=1, max_length=200), AfterValidator(_printable)]
PositiveFloat = Annotated[float, Field(gt=0, allow_inf_nan=False)]
