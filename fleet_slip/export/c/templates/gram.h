/* Gram rows of a drive, exported by fleet-slip. Do not edit. */
#ifndef ${upper}_GRAM_H
#define ${upper}_GRAM_H

#include <stdbool.h>
#include <stdint.h>

/* A count that is missing; one beyond its range is, too. */
#define ${upper}_GRAM_MISSING ${missing}
/* Sets of signals that are kept apart: rows of further ones are lost, and counted. */
#define ${upper}_GRAM_PARTS ${most_parts}U
/* Most rows of a drive: no sum of so many products reaches 2^61. */
#define ${upper}_GRAM_MOST_ROWS ${most_rows}U
#define ${upper}_GRAM_LONGEST_MESSAGE ${longest_message}U

/* Counts of one tick: physical = scale * count. */
typedef struct {
${fields}
} ${prefix}_gram_sample;

typedef struct {
    uint32_t mask; /* a bit for each signal that its rows have */
    uint32_t over; /* which time they change over */
    uint32_t rows;
} ${prefix}_gram_part;
${track_type}
typedef struct {
    ${prefix}_gram_part parts[${parts}];
    int64_t numbers[${numbers}]; /* sums, then products, of each part */
    uint32_t used[${sets}];
    uint32_t lost[${sets}];
${state}} ${prefix}_gram;

/* Begins a drive.${start_comment} */
void ${prefix}_gram_start(${prefix}_gram *gram${late});

/* Counts a tick that was logged. One without a message is not counted: ${otherwise}. */
void ${prefix}_gram_add(${prefix}_gram *gram, const ${prefix}_gram_sample *sample);
${pass}
/* At the end of a drive, for part = 0, 1, ...: writes a message of at most
 * ${upper}_GRAM_LONGEST_MESSAGE bytes and returns its length, 0 where there is no such part.
 * vehicle is the car's name, ${longest_vehicle} bytes of ASCII with zeros behind it; start_s when
 * the drive began, in seconds since 1970 in UTC. */
uint32_t ${prefix}_gram_message(const ${prefix}_gram *gram, uint32_t part, const uint8_t *vehicle,
                               uint64_t start_s, uint8_t *message);

#endif
