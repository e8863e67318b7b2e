"""Gram rows in C99: what a car counts at each tick of a drive, and the messages that tell it.

The layout of a message is that of `fleet_slip.grams.received.messages`. Of each feature set as many
rows are counted as no sum of products can reach 2^61 of: nothing overflows. Columns are computed by
the steps of an exported estimator, changes of them as `fleet_slip.grams.rows.course_sums` does.
The C stands in `templates/`.
"""

import re
from collections.abc import Mapping, Sequence
from itertools import accumulate

from fleet_slip.export.c.c_changes import words_of_sets
from fleet_slip.export.c.c_names import array_of, indented, read_template, table_of
from fleet_slip.export.c.c_source import helper_texts, sample_lines
from fleet_slip.export.c.c_steps import StepWriter
from fleet_slip.export.c.on_board import OnBoard, lower
from fleet_slip.grams.received.messages import (
    HEADER_BYTES,
    LAYOUT,
    LONGEST_VEHICLE,
    MAGIC,
    MOST_PARTS,
    MOST_ROWS,
    message_size,
)
from fleet_slip.grams.received.plausible import most_rows
from fleet_slip.regression.exact.gram import packed_size

_HELPER = re.compile(r"^static \w+ (\w+)\(", re.MULTILINE)


def c_gram_header(prefix: str, sets: Sequence[OnBoard]) -> str:
    """Return the header: what is kept, and the functions."""
    return read_template("gram.h").substitute(_words(prefix, sets))


def c_gram_source(prefix: str, sets: Sequence[OnBoard]) -> str:
    """Return the source that goes with the header."""
    text = read_template("gram.c").substitute(_words(prefix, sets))
    for name in _HELPER.findall(text):  # the model's own functions may have these names
        text = re.sub(rf"\b{name}\(", f"gram_{name}(", text)
    return text


def _words(prefix: str, sets: Sequence[OnBoard]) -> Mapping[str, object]:
    """Return what is filled into the templates of header and source."""
    steps, places = lower(sets)
    writer = StepWriter(steps)
    parts = [MOST_PARTS * max(1, len(one.of.times)) for one in sets]
    sizes = [len(one.columns) + packed_size(len(one.columns)) for one in sets]
    words = {
        "prefix": prefix,
        "upper": prefix.upper(),
        "sets": len(sets),
        "most_parts": MOST_PARTS,
        "most_rows": MOST_ROWS,
        "parts": sum(parts),
        "numbers": sum(part * size for part, size in zip(parts, sizes, strict=True)),
        "longest_vehicle": LONGEST_VEHICLE,
        "longest_message": max(
            message_size(len(one.columns), of_set=number > 0) for number, one in enumerate(sets)
        ),
        "header_bytes": HEADER_BYTES,
        "magic": "\n".join(
            f"    message[{i}] = {byte}U; /* {chr(byte)} */" for i, byte in enumerate(MAGIC)
        ),
        "magic_bytes": len(MAGIC),
        "comment": "\n".join(_comments(sets)),
        "counted": table_of(_counted(sets, parts, sizes)),
    }
    words |= _of_signals(prefix, writer, places, sets[0])
    if len(sets) > 1:
        words |= words_of_sets(prefix, steps, writer, places, sets)
    return words | {"helpers": "\n".join(helper_texts(writer))}


def _comments(sets: Sequence[OnBoard]) -> list[str]:
    """Return which columns each set has, a bit of its mask each, the first the lowest."""
    lines = [f" * {one.of.identity}: {', '.join(one.columns)}." for one in sets]
    return [*lines[:-1], f"{lines[-1]} */"]


def _counted(
    sets: Sequence[OnBoard], parts: Sequence[int], sizes: Sequence[int]
) -> list[list[str]]:
    """Return the table of sets, a field of `counted_set` each."""
    numbers = [part * size for part, size in zip(parts, sizes, strict=True)]
    firsts = zip(accumulate(parts, initial=0), accumulate(numbers, initial=0), strict=True)
    return [
        [
            f"{len(one.columns)}U",
            f"{part}U",
            f"{first_part}U",
            f"{first_number}U",
            f"{most_rows(one.ranges)}U",
            f"0x{one.of.definition:016X}ULL",
            "true" if one.complete else "false",
        ]
        for one, part, (first_part, first_number) in zip(sets, parts, firsts, strict=False)
    ]


def _of_signals(
    prefix: str, writer: StepWriter, places: Mapping[str, int], plain: OnBoard
) -> dict[str, str]:
    """Return the words of what counts the logged signals alone."""
    row = [writer.kept(places[name]) for name in plain.columns]
    body = [*writer.lines, *array_of("row", row), "count_row(gram, 0U, 0U, row);"]
    add = f"void {prefix}_gram_add({prefix}_gram *gram, const {prefix}_gram_sample *sample)"
    return {
        "missing": "INT16_MIN",
        "fields": indented(sample_lines(writer.program, "int16_t")).rstrip("\n"),
        "track_type": "",
        "state": "",
        "start_comment": "",
        "late": "",
        "otherwise": "do not call it then",
        "pass": "",
        "changes": "",
        "start": "",
        "tick": f"\n{add}\n{{\n{indented(body)}}}\n",
        "columns_bits": "",
        "layout": f"{LAYOUT}U",
        "which": "from->mask",
        "columns": "",
    }
