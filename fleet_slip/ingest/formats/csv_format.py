"""How a CSV file is written."""

from pydantic import field_validator, model_validator

from fleet_slip.config import Config


class CsvFormat(Config):
    """How a CSV file is written. It is always UTF-8, with or without a byte order mark."""

    separator: str = ","
    decimal_comma: bool = False

    @field_validator("separator")
    @classmethod
    def _one_character(cls, separator: str) -> str:
        if len(separator) != 1 or not separator.isascii() or separator in '"\r\n\0':
            raise ValueError("must be one ASCII character such as ',', ';' or a tab")
        return separator

    @model_validator(mode="after")
    def _unambiguous(self) -> "CsvFormat":
        if self.decimal_comma and self.separator == ",":
            raise ValueError("with decimal_comma the separator cannot be ',': set it, often ';'")
        return self
