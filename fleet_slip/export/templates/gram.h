/* Gram rows of a drive, exported by fleet-slip. Do not edit. */
#ifndef ${upper}_GRAM_H
#define ${upper}_GRAM_H

#include <stdbool.h>
#include <stdint.h>

/* A count that is missing; one beyond its range is, too. */
#define ${upper}_GRAM_MISSING ${"INT32_MIN" if changed else "INT16_MIN"}
/* Sets of signals that are kept apart: rows of further ones are lost, and counted. */
#define ${upper}_GRAM_PARTS ${most_parts}U
/* Most rows of a drive: no sum of so many products reaches 2^61. */
#define ${upper}_GRAM_MOST_ROWS ${most_rows}U
#define ${upper}_GRAM_LONGEST_MESSAGE ${longest_message}U

/* Counts of one tick: physical = scale * count. */
typedef struct {
//% set kind = "int32_t" if changed else "int16_t"
//% include "templates/sample.h"
} ${prefix}_gram_sample;

typedef struct {
    uint32_t mask; /* a bit for each signal that its rows have */
    uint32_t over; /* which time they change over */
    uint32_t rows;
} ${prefix}_gram_part;

//% if changed
/* Course and yaw rate of a tick; the sum of the yaw rate, and for how many ticks it was there. */
typedef struct {
    int32_t course;
    int32_t yaw_rate;
    uint32_t turned;
    uint32_t run;
} ${prefix}_gram_track;

//% endif
typedef struct {
    ${prefix}_gram_part parts[${parts}];
    int64_t numbers[${numbers}]; /* sums, then products, of each part */
    uint32_t used[${sets|length}];
    uint32_t lost[${sets|length}];
//% if changed
//% for one in state
    ${one.declared}
//% endfor
//% for number, one in changed
    int32_t columns_${number}[${one.kept_ticks * one.computed|length}];
    uint32_t at_columns_${number};
//% endfor
    ${prefix}_gram_track track[${track}];
    uint32_t at;
    int32_t late;
    bool began;
//% endif
} ${prefix}_gram;

//% if changed
/* Begins a drive. late is the delay of the course in ${late_ms} ms, from
 * ${earliest} to ${latest}; 0 where it is not known. */
void ${prefix}_gram_start(${prefix}_gram *gram, int32_t late);

//% else
/* Begins a drive. */
void ${prefix}_gram_start(${prefix}_gram *gram);

//% endif
/* Counts a tick that was logged. One without a message is not counted: ${"pass it over" if changed else "do not call it then"}. */
void ${prefix}_gram_add(${prefix}_gram *gram, const ${prefix}_gram_sample *sample);

//% if changed
/* Passes over a tick that was not logged. */
void ${prefix}_gram_pass(${prefix}_gram *gram);

//% endif
/* At the end of a drive, for part = 0, 1, ...: writes a message of at most
 * ${upper}_GRAM_LONGEST_MESSAGE bytes and returns its length, 0 where there is no such part.
 * vehicle is the car's name, ${longest_vehicle} bytes of ASCII with zeros behind it; start_s when
 * the drive began, in seconds since 1970 in UTC. */
uint32_t ${prefix}_gram_message(const ${prefix}_gram *gram, uint32_t part, const uint8_t *vehicle,
                               uint64_t start_s, uint8_t *message);

#endif
