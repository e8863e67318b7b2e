/* Gram rows of a drive, exported by fleet-slip. Do not edit. */
#ifndef ${upper}_GRAM_H
#define ${upper}_GRAM_H

#include <stdbool.h>
#include <stdint.h>

/* Missing count. A count outside its range is missing, too. */
#define ${upper}_GRAM_MISSING ${"INT32_MIN" if changed else "INT16_MIN"}
/* Blocks of a drive, one for each combination of valid signals. Rows of further ones are lost. */
#define ${upper}_GRAM_PARTS ${max_blocks}U
/* Maximum number of rows of a drive: no sum of products reaches 2^61. */
#define ${upper}_GRAM_MOST_ROWS ${max_rows}U
#define ${upper}_GRAM_LONGEST_MESSAGE ${max_message}U

/* Counts of one tick: physical = scale * count. */
typedef struct {
//% set kind = "int32_t" if changed else "int16_t"
//% include "templates/sample.h"
} ${prefix}_gram_sample;

typedef struct {
    uint32_t mask; /* one bit for each valid signal of its rows */
    uint32_t over; /* index of the time of changes */
    uint32_t rows;
} ${prefix}_gram_block;

//% if changed
/* Course and yaw rate of a tick, sum of the yaw rate, and ticks since it was missing. */
typedef struct {
    int32_t course;
    int32_t yaw_rate;
    uint32_t turned;
    uint32_t run;
} ${prefix}_gram_motion;

//% endif
typedef struct {
    ${prefix}_gram_block blocks[${blocks|sum}];
    int64_t numbers[${numbers|sum}]; /* sums, then products, of each block */
    uint32_t used[${sets|length}];
    uint32_t lost[${sets|length}];
//% if changed
//% for one in state
    ${one.declared}
//% endfor
//% for number, one in changed
    int32_t columns_${number}[${one.history_ticks * one.computed|length}];
    uint32_t at_columns_${number};
//% endfor
    ${prefix}_gram_motion history[${history}];
    uint32_t at;
    int32_t delay;
    bool started;
//% endif
} ${prefix}_gram;

//% if changed
/* Starts a drive. delay is the delay of the course in units of ${delay_ms} ms, from
 * ${delay_parts * min_delay} to ${delay_parts * max_delay}; 0 if it is unknown. */
void ${prefix}_gram_start(${prefix}_gram *gram, int32_t delay);

//% else
/* Starts a drive. */
void ${prefix}_gram_start(${prefix}_gram *gram);

//% endif
/* Counts a tick with a message. ${"Call pass for other ticks" if changed else "Do not call it for other ticks"}. */
void ${prefix}_gram_add(${prefix}_gram *gram, const ${prefix}_gram_sample *sample);

//% if changed
/* Advances by a tick without a message. */
void ${prefix}_gram_pass(${prefix}_gram *gram);

//% endif
/* Writes the message of a block, for part = 0, 1, ... at the end of a drive. It has at most
 * ${upper}_GRAM_LONGEST_MESSAGE bytes. Returns its length, or 0 if there is no such block.
 * vehicle is the name of the car, ${max_vehicle} bytes of ASCII, zero-padded. start_s is the start
 * of the drive in seconds since 1970 in UTC. */
uint32_t ${prefix}_gram_message(const ${prefix}_gram *gram, uint32_t part, const uint8_t *vehicle,
                               uint64_t start_s, uint8_t *message);

#endif
