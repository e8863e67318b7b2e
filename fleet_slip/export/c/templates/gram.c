/* Gram rows of a drive, exported by fleet-slip. Do not edit.
 * Signals, a bit of a mask each, the first the lowest: ${names}. */
#include "${prefix}_gram.h"

#define SIGNALS ${signals}U
#define MISSING INT32_MIN

static int32_t in_range(int32_t value, int32_t least, int32_t most)
{
    return ((value < least) || (value > most)) ? MISSING : value;
}

/* The part of a set of signals, begun if it is new; the number of parts if none is left. */
static uint32_t part_of(${prefix}_gram *gram, uint32_t mask)
{
    uint32_t found = 0U;
    while ((found < gram->used) && (gram->parts[found].mask != mask)) {
        found++;
    }
    if ((found == gram->used) && (found < ${most_parts}U)) {
        ${prefix}_gram_part *const part = &gram->parts[found];
        part->mask = mask;
        part->rows = 0U;
        for (uint32_t i = 0U; i < SIGNALS; i++) {
            part->sums[i] = 0;
        }
        for (uint32_t i = 0U; i < ${products}U; i++) {
            part->products[i] = 0;
        }
        gram->used++;
    }
    return found;
}

void ${prefix}_gram_start(${prefix}_gram *gram)
{
    gram->used = 0U;
    gram->lost = 0U;
}

void ${prefix}_gram_add(${prefix}_gram *gram, const ${prefix}_gram_sample *sample)
{
    int32_t counts[SIGNALS];
${takes}
    uint32_t mask = 0U;
    for (uint32_t i = 0U; i < SIGNALS; i++) {
        if (counts[i] == MISSING) {
            counts[i] = 0; /* adds nothing */
        } else {
            mask |= ((uint32_t)1U << i);
        }
    }
    const uint32_t found = part_of(gram, mask);
    if ((found == ${most_parts}U) || (gram->parts[found].rows == ${most_rows}U)) {
        gram->lost += (gram->lost < ${most_rows}U) ? 1U : 0U;
    } else {
        ${prefix}_gram_part *const part = &gram->parts[found];
        uint32_t at = 0U;
        part->rows++;
        for (uint32_t i = 0U; i < SIGNALS; i++) {
            part->sums[i] += counts[i];
            for (uint32_t j = 0U; j <= i; j++) {
                part->products[at] += counts[i] * counts[j];
                at++;
            }
        }
    }
}

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

uint32_t ${prefix}_gram_message(const ${prefix}_gram *gram, uint32_t part, const uint8_t *vehicle,
                               uint64_t start_s, uint8_t *message)
{
    if (part >= gram->used) {
        return 0U;
    }
    const ${prefix}_gram_part *const from = &gram->parts[part];
${magic}
    uint32_t at = put(message, ${magic_bytes}U, ${layout}U, 2U);
    at = put(message, at, 0U, 2U); /* the length, below */
    at = put(message, at, UINT64_C(0x${definition}), 8U);
    for (uint32_t i = 0U; i < ${longest_vehicle}U; i++) {
        at = put(message, at, vehicle[i], 1U);
    }
    at = put(message, at, part, 2U);
    at = put(message, at, gram->used, 2U);
    at = put(message, at, start_s, 8U);
    at = put(message, at, from->mask, 4U);
    at = put(message, at, from->rows, 4U);
    at = put(message, at, gram->lost, 4U); /* byte ${header_bytes} is next */
    for (uint32_t i = 0U; i < SIGNALS; i++) {
        if (((from->mask >> i) & 1U) != 0U) {
            at = put(message, at, (uint64_t)from->sums[i], 8U);
        }
    }
    uint32_t product = 0U;
    for (uint32_t i = 0U; i < SIGNALS; i++) {
        for (uint32_t j = 0U; j <= i; j++) {
            if ((((from->mask >> i) & (from->mask >> j)) & 1U) != 0U) {
                at = put(message, at, (uint64_t)from->products[product], 8U);
            }
            product++;
        }
    }
    (void)put(message, 6U, (uint64_t)at + 4U, 2U);
    return put(message, at, crc_32(message, at), 4U);
}
