/* Gram rows of a drive, exported by fleet-slip. Do not edit.
 * Columns of rows by feature set, a bit of a mask each, the first the lowest:
//% for one in sets
 * ${one.of.identity}: ${one.columns|join(", ")}.${" */" if loop.last}
//% endfor
#include "${prefix}_gram.h"

#define SETS ${sets|length}U
#define MISSING INT32_MIN

/* What is counted of a feature set. */
typedef struct {
    uint32_t columns;
    uint32_t parts;
    uint32_t first_part;
    uint32_t first_number;
    uint32_t most_rows;
    uint64_t definition;
    bool complete; /* rows that lack some columns are not counted */
} counted_set;

static const counted_set counted[SETS] = {
//% for one in counted
    {${one|join(", ")}}${"," if not loop.last}
//% endfor
};

//% for helper in helpers
${helper}
//% endfor
/* Sums and products of so many columns. */
static uint32_t numbers_of(uint32_t columns)
{
    return columns + ((columns * (columns + 1U)) / 2U);
}

/* Counts a row of a feature set, over one of the times that it changes over. */
static void count_row(${prefix}_gram *gram, uint32_t set, uint32_t over, int32_t *row)
{
    const counted_set *const of = &counted[set];
    uint32_t mask = 0U;
    uint32_t lacking = 0U;
    for (uint32_t i = 0U; i < of->columns; i++) {
        if (row[i] == MISSING) {
            row[i] = 0; /* adds nothing */
            lacking++;
        } else {
            mask |= ((uint32_t)1U << i);
        }
    }
    uint32_t found = 0U;
    if (of->complete && (lacking > 0U) && (lacking < of->columns)) {
        return;
    }
    while ((found < gram->used[set]) && ((gram->parts[of->first_part + found].mask != mask) ||
                                         (gram->parts[of->first_part + found].over != over))) {
        found++;
    }
    const bool is_new = (found == gram->used[set]) && (found < of->parts);
    const uint32_t size = numbers_of(of->columns);
    if (is_new) {
        ${prefix}_gram_part *const part = &gram->parts[of->first_part + found];
        part->mask = mask;
        part->over = over;
        part->rows = 0U;
        for (uint32_t i = 0U; i < size; i++) {
            gram->numbers[of->first_number + (found * size) + i] = 0;
        }
        gram->used[set]++;
    }
    if ((found == of->parts) || (gram->parts[of->first_part + found].rows == of->most_rows)) {
        gram->lost[set] += (gram->lost[set] < ${most_rows}U) ? 1U : 0U;
    } else {
        uint32_t at = of->first_number + (found * size);
        gram->parts[of->first_part + found].rows++;
        for (uint32_t i = 0U; i < of->columns; i++) {
            gram->numbers[at] += row[i];
            at++;
        }
        for (uint32_t i = 0U; i < of->columns; i++) {
            for (uint32_t j = 0U; j <= i; j++) {
                gram->numbers[at] += (int64_t)row[i] * row[j];
                at++;
            }
        }
    }
}

//% if changed
//% include "templates/gram_changes.c"
//% endif
void ${prefix}_gram_start(${prefix}_gram *gram${", int32_t late" if changed})
{
    for (uint32_t i = 0U; i < SETS; i++) {
        gram->used[i] = 0U;
        gram->lost[i] = 0U;
    }
//% if changed
//% if "state->" in start|join
    ${prefix}_gram *const state = gram;
//% endif
//% for line in start
    ${line}
//% endfor
//% for number, _ in changed
    gram->at_columns_${number} = 0U;
//% endfor
    for (uint32_t i = 0U; i < TRACK; i++) {
        gram->track[i].course = MISSING;
        gram->track[i].yaw_rate = 0;
        gram->track[i].turned = 0U;
        gram->track[i].run = 0U;
    }
    gram->at = 0U;
    gram->late = (late < (${earliest})) ? (${earliest}) : ((late > ${latest}) ? ${latest} : late);
    gram->began = false;
//% endif
}

//% include "templates/gram_tick.c"
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

//% if changed
//% include "templates/gram_columns.c"
//% endif
uint32_t ${prefix}_gram_message(const ${prefix}_gram *gram, uint32_t part, const uint8_t *vehicle,
                               uint64_t start_s, uint8_t *message)
{
    uint32_t set = 0U;
    uint32_t place = part;
    while ((set < SETS) && (place >= gram->used[set])) {
        place -= gram->used[set];
        set++;
    }
    if (set == SETS) {
        return 0U;
    }
    const counted_set *const of = &counted[set];
    const ${prefix}_gram_part *const from = &gram->parts[of->first_part + place];
//% for byte in magic
    message[${loop.index0}] = ${byte}U; /* ${"%c"|format(byte)} */
//% endfor
    uint32_t at = put(message, ${magic|length}U, ${"(set == 0U) ? %sU : %sU"|format(layout, set_layout) if changed else layout ~ "U"}, 2U);
    at = put(message, at, 0U, 2U); /* the length, below */
    at = put(message, at, of->definition, 8U);
    for (uint32_t i = 0U; i < ${longest_vehicle}U; i++) {
        at = put(message, at, vehicle[i], 1U);
    }
    at = put(message, at, place, 2U);
    at = put(message, at, gram->used[set], 2U);
    at = put(message, at, start_s, 8U);
    at = put(message, at, ${"which_of(gram, set, from)" if changed else "from->mask"}, 4U);
    at = put(message, at, from->rows, 4U);
    at = put(message, at, gram->lost[set], 4U); /* byte ${header_bytes} is next */
//% if changed
    if (set > 0U) {
        at = put_columns(message, at, set, from->mask);
    }
//% endif
    uint32_t number = of->first_number + (place * numbers_of(of->columns));
    for (uint32_t i = 0U; i < of->columns; i++) {
        if (((from->mask >> i) & 1U) != 0U) {
            at = put(message, at, (uint64_t)gram->numbers[number], 8U);
        }
        number++;
    }
    for (uint32_t i = 0U; i < of->columns; i++) {
        for (uint32_t j = 0U; j <= i; j++) {
            if ((((from->mask >> i) & (from->mask >> j)) & 1U) != 0U) {
                at = put(message, at, (uint64_t)gram->numbers[number], 8U);
            }
            number++;
        }
    }
    (void)put(message, 6U, (uint64_t)at + 4U, 2U);
    return put(message, at, crc_32(message, at), 4U);
}
