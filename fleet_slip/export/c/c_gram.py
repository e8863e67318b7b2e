"""Gram rows in C99: what a car counts at each tick of a drive, and the messages that tell it.

The layout of a message is that of `fleet_slip.grams.received.messages`. Counts have 16 bits, so
that a product is at most 2^30 and a sum of `MOST_ROWS` of them below 2^61: nothing overflows.
"""

from collections.abc import Sequence

from fleet_slip.catalogue.signals import catalogue
from fleet_slip.export.c.c_names import literal
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
    signals = catalogue()
    names = signals.gram_signals
    k, upper = len(names), prefix.upper()
    fields = "\n".join(
        f"    int16_t {name}_count; /* {s.scale:f} {s.unit.replace('/', ' per ')}, "
        f"{s.min_count} to {s.max_count} */"
        for name in names
        for s in [signals[name]]
    )
    return f"""/* Gram rows of a drive, exported by fleet-slip. Do not edit. */
#ifndef {upper}_GRAM_H
#define {upper}_GRAM_H

#include <stdbool.h>
#include <stdint.h>

/* A count that is missing; one beyond its range is, too. */
#define {upper}_GRAM_MISSING INT16_MIN
/* Sets of signals that are kept apart: rows of further ones are lost, and counted. */
#define {upper}_GRAM_PARTS {MOST_PARTS}U
/* Most rows of a drive: no sum of so many products reaches 2^61. */
#define {upper}_GRAM_MOST_ROWS {MOST_ROWS}U
#define {upper}_GRAM_LONGEST_MESSAGE {message_size(k)}U

/* Counts of one tick: physical = scale * count. */
typedef struct {{
{fields}
}} {prefix}_gram_sample;

typedef struct {{
    uint32_t mask; /* a bit for each signal that its rows have */
    uint32_t rows;
    int64_t sums[{k}];
    int64_t products[{packed_size(k)}];
}} {prefix}_gram_part;

typedef struct {{
    {prefix}_gram_part parts[{MOST_PARTS}];
    uint32_t used;
    uint32_t lost;
}} {prefix}_gram;

/* Begins a drive. */
void {prefix}_gram_start({prefix}_gram *gram);

/* Counts a tick that was logged. One without a message is not counted: do not call it then. */
void {prefix}_gram_add({prefix}_gram *gram, const {prefix}_gram_sample *sample);

/* At the end of a drive, for part = 0, 1, ...: writes a message of at most
 * {upper}_GRAM_LONGEST_MESSAGE bytes and returns its length, 0 where there is no such part.
 * vehicle is the car's name, {LONGEST_VEHICLE} bytes of ASCII with zeros behind it; start_s when
 * the drive began, in seconds since 1970 in UTC. */
uint32_t {prefix}_gram_message(const {prefix}_gram *gram, uint32_t part, const uint8_t *vehicle,
                               uint64_t start_s, uint8_t *message);

#endif
"""


def c_gram_source(prefix: str) -> str:
    """Return the source that goes with the header."""
    names = catalogue().gram_signals
    counting = _beginning(prefix, names) + _parts(prefix, names) + _adding(prefix, names)
    return counting + _PUTTING + _message(prefix)


def _beginning(prefix: str, names: Sequence[str]) -> str:
    return f"""/* Gram rows of a drive, exported by fleet-slip. Do not edit.
 * Signals, a bit of a mask each, the first the lowest: {", ".join(names)}. */
#include "{prefix}_gram.h"

#define SIGNALS {len(names)}U
#define MISSING INT32_MIN

static int32_t in_range(int32_t value, int32_t least, int32_t most)
{{
    return ((value < least) || (value > most)) ? MISSING : value;
}}

"""


def _parts(prefix: str, names: Sequence[str]) -> str:
    """Return what finds the part of a tick, and what begins a drive."""
    return f"""\
/* The part of a set of signals, begun if it is new; the number of parts if none is left. */
static uint32_t part_of({prefix}_gram *gram, uint32_t mask)
{{
    uint32_t found = 0U;
    while ((found < gram->used) && (gram->parts[found].mask != mask)) {{
        found++;
    }}
    if ((found == gram->used) && (found < {MOST_PARTS}U)) {{
        {prefix}_gram_part *const part = &gram->parts[found];
        part->mask = mask;
        part->rows = 0U;
        for (uint32_t i = 0U; i < SIGNALS; i++) {{
            part->sums[i] = 0;
        }}
        for (uint32_t i = 0U; i < {packed_size(len(names))}U; i++) {{
            part->products[i] = 0;
        }}
        gram->used++;
    }}
    return found;
}}

void {prefix}_gram_start({prefix}_gram *gram)
{{
    gram->used = 0U;
    gram->lost = 0U;
}}

"""


def _adding(prefix: str, names: Sequence[str]) -> str:
    """Return what counts a tick."""
    known = catalogue()
    takes = "\n".join(
        f"    counts[{i}] = in_range(sample->{name}_count, {literal(s.min_count)}, {s.max_count});"
        for i, name in enumerate(names)
        for s in [known[name]]
    )
    return f"""\
void {prefix}_gram_add({prefix}_gram *gram, const {prefix}_gram_sample *sample)
{{
    int32_t counts[SIGNALS];
{takes}
    uint32_t mask = 0U;
    for (uint32_t i = 0U; i < SIGNALS; i++) {{
        if (counts[i] == MISSING) {{
            counts[i] = 0; /* adds nothing */
        }} else {{
            mask |= ((uint32_t)1U << i);
        }}
    }}
    const uint32_t found = part_of(gram, mask);
    if ((found == {MOST_PARTS}U) || (gram->parts[found].rows == {MOST_ROWS}U)) {{
        gram->lost += (gram->lost < {MOST_ROWS}U) ? 1U : 0U;
    }} else {{
        {prefix}_gram_part *const part = &gram->parts[found];
        uint32_t at = 0U;
        part->rows++;
        for (uint32_t i = 0U; i < SIGNALS; i++) {{
            part->sums[i] += counts[i];
            for (uint32_t j = 0U; j <= i; j++) {{
                part->products[at] += counts[i] * counts[j];
                at++;
            }}
        }}
    }}
}}

"""


_PUTTING = """\
/* Writes the lowest bytes of a number, the lowest first; returns where the next one goes. */
static uint32_t put(uint8_t *message, uint32_t at, uint64_t value, uint32_t bytes)
{
    uint64_t rest = value;
    for (uint32_t i = 0U; i < bytes; i++) {
        message[at + i] = (uint8_t)(rest & 0xFFU);
        rest >>= 8U;
    }
    return at + bytes;
}

/* CRC-32 as in Ethernet and zlib. */
static uint32_t crc_32(const uint8_t *bytes, uint32_t size)
{
    uint32_t crc = 0xFFFFFFFFU;
    for (uint32_t i = 0U; i < size; i++) {
        crc ^= bytes[i];
        for (uint32_t bit = 0U; bit < 8U; bit++) {
            crc = ((crc & 1U) != 0U) ? ((crc >> 1U) ^ 0xEDB88320U) : (crc >> 1U);
        }
    }
    return ~crc;
}

"""
"""What writes a number, and the checksum of a message."""


def _message(prefix: str) -> str:
    """Return what writes the message of a part."""
    magic = "\n".join(
        f"    message[{i}] = {byte}U; /* {chr(byte)} */" for i, byte in enumerate(MAGIC)
    )
    return f"""\
uint32_t {prefix}_gram_message(const {prefix}_gram *gram, uint32_t part, const uint8_t *vehicle,
                               uint64_t start_s, uint8_t *message)
{{
    if (part >= gram->used) {{
        return 0U;
    }}
    const {prefix}_gram_part *const from = &gram->parts[part];
{magic}
    uint32_t at = put(message, {len(MAGIC)}U, {LAYOUT}U, 2U);
    at = put(message, at, 0U, 2U); /* the length, below */
    at = put(message, at, UINT64_C(0x{signals_definition():016X}), 8U);
    for (uint32_t i = 0U; i < {LONGEST_VEHICLE}U; i++) {{
        at = put(message, at, vehicle[i], 1U);
    }}
    at = put(message, at, part, 2U);
    at = put(message, at, gram->used, 2U);
    at = put(message, at, start_s, 8U);
    at = put(message, at, from->mask, 4U);
    at = put(message, at, from->rows, 4U);
    at = put(message, at, gram->lost, 4U); /* byte {HEADER_BYTES} is next */
    for (uint32_t i = 0U; i < SIGNALS; i++) {{
        if (((from->mask >> i) & 1U) != 0U) {{
            at = put(message, at, (uint64_t)from->sums[i], 8U);
        }}
    }}
    uint32_t product = 0U;
    for (uint32_t i = 0U; i < SIGNALS; i++) {{
        for (uint32_t j = 0U; j <= i; j++) {{
            if ((((from->mask >> i) & (from->mask >> j)) & 1U) != 0U) {{
                at = put(message, at, (uint64_t)from->products[product], 8U);
            }}
            product++;
        }}
    }}
    (void)put(message, 6U, (uint64_t)at + 4U, 2U);
    return put(message, at, crc_32(message, at), 4U);
}}
"""
