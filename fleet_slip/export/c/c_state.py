"""What an exported estimator in C keeps from tick to tick: the fields of its state, its size."""

from dataclasses import dataclass

from fleet_slip.export.c.c_names import field_names
from fleet_slip.export.c.c_steps import ring_width, sum_key, sum_type
from fleet_slip.export.program import Program


@dataclass(frozen=True)
class Field:
    """A field of a struct: words of a type such as `int16_t`; an array if there are several."""

    type: str
    name: str
    words: int = 1
    array: bool = False
    comment: str = ""

    @property
    def word_bytes(self) -> int:
        """Bytes of a word, and what its address is a multiple of."""
        return int("".join(c for c in self.type if c.isdigit())) // 8

    @property
    def declared(self) -> str:
        """The field as it stands in C."""
        size = f"[{self.words}]" if self.array else ""
        comment = f" /* {self.comment} */" if self.comment else ""
        return f"{self.type} {self.name}{size};{comment}"


def state_fields(program: Program) -> list[Field]:
    """Return the fields of the state: rings of steps, sums, what the car knows."""
    names, found = field_names(program), []
    for of, ticks in program.rings.items():
        if ticks:
            kind = f"int{ring_width(program, of)}_t"
            found += [
                Field(kind, f"ring_{of}", ticks, array=True, comment=f"step {of}"),
                Field("uint32_t", f"at_{of}"),
            ]
    for of, ticks, most in program.sums:
        key, kind = sum_key(of, ticks, most), sum_type(program, of, most)
        found += [Field(kind, f"sum_{key}"), Field("uint32_t", f"values_{key}")]
    found += [Field("int32_t", name) for name in (*names["facts"], *names["numbers"])]
    nothing = Field("uint8_t", "nothing", comment="this model looks back on nothing")
    return found or [nothing]


def state_bytes(program: Program) -> int:
    """Return the size of the state where a word of n bytes lies at a multiple of n, as on ARM."""
    fields, at = state_fields(program), 0
    for one in fields:
        at += -at % one.word_bytes + one.words * one.word_bytes
    return at + -at % max(one.word_bytes for one in fields)
