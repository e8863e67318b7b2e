/* Gram rows of a drive, exported by fleet-slip. Do not edit.
 * Columns of rows by feature set, one bit of a mask each, the first one lowest:
//% for one in sets
 * ${one.counted.identity}: ${one.columns|join(", ")}.${" */" if loop.last}
//% endfor
#include "${prefix}_gram.h"

#define SETS ${sets|length}U
#define MISSING INT32_MIN

/* Layout of a feature set. */
typedef struct {
    uint32_t columns;
    uint32_t blocks;
    uint32_t first_block;
    uint32_t first_number;
    uint32_t max_rows;
    uint64_t definition;
    bool complete; /* rows with some, but not all columns are not counted */
} counted_set;

static const counted_set counted[SETS] = {
//% for one in sets
//% set i = loop.index0
    {${one.columns|length}U, ${blocks[i]}U, ${first_blocks[i]}U, ${first_numbers[i]}U, ${row_limits[i]}U, 0x${"%016X"|format(one.counted.definition)}ULL, ${one.complete|lower}}${"," if not loop.last}
//% endfor
};

//% for helper in helpers
${helper}
//% endfor
/* Number of sums and products of columns. */
static uint32_t numbers_of(uint32_t columns)
{
    return columns + ((columns * (columns + 1U)) / 2U);
}

/* Counts a row of a feature set, for one of the times of its changes. */
static void count_row(${prefix}_gram *gram, uint32_t set, uint32_t over, int32_t *row)
{
    const counted_set *const spec = &counted[set];
    uint32_t mask = 0U;
    uint32_t lacking = 0U;
    for (uint32_t i = 0U; i < spec->columns; i++) {
        if (row[i] == MISSING) {
            row[i] = 0; /* adds 0 */
            lacking++;
        } else {
            mask |= ((uint32_t)1U << i);
        }
    }
    uint32_t index = 0U;
    if (spec->complete && (lacking > 0U) && (lacking < spec->columns)) {
        return;
    }
    while ((index < gram->used[set]) && ((gram->blocks[spec->first_block + index].mask != mask) ||
                                         (gram->blocks[spec->first_block + index].over != over))) {
        index++;
    }
    const bool is_new = (index == gram->used[set]) && (index < spec->blocks);
    const uint32_t size = numbers_of(spec->columns);
    if (is_new) {
        ${prefix}_gram_block *const block = &gram->blocks[spec->first_block + index];
        block->mask = mask;
        block->over = over;
        block->rows = 0U;
        for (uint32_t i = 0U; i < size; i++) {
            gram->numbers[spec->first_number + (index * size) + i] = 0;
        }
        gram->used[set]++;
    }
    if ((index == spec->blocks) || (gram->blocks[spec->first_block + index].rows == spec->max_rows)) {
        gram->lost[set] += (gram->lost[set] < ${max_rows}U) ? 1U : 0U;
    } else {
        uint32_t at = spec->first_number + (index * size);
        gram->blocks[spec->first_block + index].rows++;
        for (uint32_t i = 0U; i < spec->columns; i++) {
            gram->numbers[at] += row[i];
            at++;
        }
        for (uint32_t i = 0U; i < spec->columns; i++) {
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
void ${prefix}_gram_start(${prefix}_gram *gram${", int32_t delay" if changed})
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
    for (uint32_t i = 0U; i < HISTORY; i++) {
        gram->history[i].course = MISSING;
        gram->history[i].yaw_rate = 0;
        gram->history[i].turned = 0U;
        gram->history[i].run = 0U;
    }
    gram->at = 0U;
    gram->delay = (delay < (${delay_parts * min_delay})) ? (${delay_parts * min_delay}) : ((delay > ${delay_parts * max_delay}) ? ${delay_parts * max_delay} : delay);
    gram->started = false;
//% endif
}

//% include "templates/gram_tick.c"
/* Writes a number, the lowest byte first; returns the next index. */
static uint32_t put(uint8_t *message, uint32_t at, uint64_t value, uint32_t bytes)
{
    uint64_t remaining = value;
    for (uint32_t i = 0U; i < bytes; i++) {
        message[at + i] = (uint8_t)(remaining & 0xFFU);
        remaining >>= 8U;
    }
    return at + bytes;
}

/* CRC-32 of Ethernet and zlib. */
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
    uint32_t index = part;
    while ((set < SETS) && (index >= gram->used[set])) {
        index -= gram->used[set];
        set++;
    }
    if (set == SETS) {
        return 0U;
    }
    const counted_set *const spec = &counted[set];
    const ${prefix}_gram_block *const block = &gram->blocks[spec->first_block + index];
//% for byte in magic
    message[${loop.index0}] = ${byte}U; /* ${"%c"|format(byte)} */
//% endfor
    uint32_t at = put(message, ${magic|length}U, ${"(set == 0U) ? %sU : %sU"|format(layout, set_layout) if changed else layout ~ "U"}, 2U);
    at = put(message, at, 0U, 2U); /* length, written below */
    at = put(message, at, spec->definition, 8U);
    for (uint32_t i = 0U; i < ${max_vehicle}U; i++) {
        at = put(message, at, vehicle[i], 1U);
    }
    at = put(message, at, index, 2U);
    at = put(message, at, gram->used[set], 2U);
    at = put(message, at, start_s, 8U);
    at = put(message, at, ${"contents_of(gram, set, block)" if changed else "block->mask"}, 4U);
    at = put(message, at, block->rows, 4U);
    at = put(message, at, gram->lost[set], 4U); /* the header ends at byte ${header_bytes} */
//% if changed
    if (set > 0U) {
        at = put_columns(message, at, set, block->mask);
    }
//% endif
    uint32_t number = spec->first_number + (index * numbers_of(spec->columns));
    for (uint32_t i = 0U; i < spec->columns; i++) {
        if (((block->mask >> i) & 1U) != 0U) {
            at = put(message, at, (uint64_t)gram->numbers[number], 8U);
        }
        number++;
    }
    for (uint32_t i = 0U; i < spec->columns; i++) {
        for (uint32_t j = 0U; j <= i; j++) {
            if ((((block->mask >> i) & (block->mask >> j)) & 1U) != 0U) {
                at = put(message, at, (uint64_t)gram->numbers[number], 8U);
            }
            number++;
        }
    }
    (void)put(message, 6U, (uint64_t)at + 4U, 2U);
    return put(message, at, crc_32(message, at), 4U);
}
