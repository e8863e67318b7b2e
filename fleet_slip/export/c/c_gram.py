"""Gram rows in C99: what a car counts at each tick of a drive, and the messages that tell it.

The layout of a message is that of `fleet_slip.grams.received.messages`. Counts have 16 bits, so
that a product is at most 2^30 and a sum of `MOST_ROWS` of them below 2^61: nothing overflows.
The C stands in `templates/`.
"""

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.export.c.c_names import literal, read_template
from fleet_slip.grams.received.messages import (
    HEADER_BYTES,
    LAYOUT,
    LONGEST_VEHICLE,
    MAGIC,
    MOST_PARTS,
    MOST_ROWS,
    message_size,
    signals_definition,
)
from fleet_slip.regression.exact.gram import packed_size


def c_gram_header(prefix: str) -> str:
    """Return the header: what is kept, and three functions."""
    return _filled("gram.h", prefix)


def c_gram_source(prefix: str) -> str:
    """Return the source that goes with the header."""
    return _filled("gram.c", prefix)


def _filled(template: str, prefix: str) -> str:
    signals = {name: catalogue()[name] for name in catalogue().gram_signals}
    fields = "\n".join(
        f"    int16_t {name}_count; /* {one.scale:f} {one.unit.replace('/', ' per ')}, "
        f"{one.min_count} to {one.max_count} */"
        for name, one in signals.items()
    )
    takes = "\n".join(
        f"    counts[{i}] = "
        f"in_range(sample->{name}_count, {literal(one.min_count)}, {one.max_count});"
        for i, (name, one) in enumerate(signals.items())
    )
    magic = (f"    message[{i}] = {byte}U; /* {chr(byte)} */" for i, byte in enumerate(MAGIC))
    return read_template(template).substitute(
        prefix=prefix,
        upper=prefix.upper(),
        names=", ".join(signals),
        signals=len(signals),
        products=packed_size(len(signals)),
        fields=fields,
        takes=takes,
        most_parts=MOST_PARTS,
        most_rows=MOST_ROWS,
        longest_message=message_size(len(signals)),
        longest_vehicle=LONGEST_VEHICLE,
        header_bytes=HEADER_BYTES,
        magic="\n".join(magic),
        magic_bytes=len(MAGIC),
        layout=LAYOUT,
        definition=f"{signals_definition():016X}",
    )
