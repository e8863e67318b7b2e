//% include "templates/preamble.h"
#ifndef ${upper}_H
#define ${upper}_H

#include <stdbool.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define ${upper}_MODEL "${version.reference}"
#define ${upper}_SHA256 "${version.sha256}"
#define ${upper}_DRIVES_SHA256 "${trained.drives_sha256 or ""}"

/* Axes: ${axes}. */
#define ${upper}_TICK_S ${tick_s}
//% for one, name in zip(program.signals, scale_names)
#define ${name} ${one.scale|decimal} /* ${one.unit|unit} */
//% endfor
#define ${upper}_ANGLE_SCALE ${angle.scale|decimal} /* ${angle.unit|unit} */

/* A count that is missing; one beyond its range is, too. */
#define ${upper}_MISSING INT16_MIN

/* Counts of one tick: physical = scale * count. */
typedef struct {
//% set kind = "int16_t"
//% include "templates/sample.h"
} ${prefix}_sample;

//% if knows
/* What a car does not know. */
#define ${upper}_UNKNOWN INT32_MIN

/* What a car knows of itself. */
typedef struct {
//% for one, field in zip(program.facts, fields.facts)
    int32_t ${field}; /* ${"whole number" if one.equals is none else "1 or 0"} */
//% endfor
//% for one, field in zip(program.numbers, fields.numbers)
    int32_t ${field}; /* ${one.grain|decimal} ${one.unit|unit} */
//% endfor
} ${prefix}_car;

//% endif
/* What is kept from tick to tick. */
typedef struct {
//% for one in state
    ${one.declared}
//% endfor
} ${prefix}_state;

/* Begins a drive. */
void ${prefix}_start(${prefix}_state *state${", const " ~ prefix ~ "_car *car" if knows});

//% if program.learned
/* Begins another drive of the same car, which remembers so many of 256 parts of what drives have
 * taught it of load and tyres. The state must be kept meanwhile, in memory that needs no power. */
void ${prefix}_next(${prefix}_state *state, ${"const " ~ prefix ~ "_car *car, " if knows}uint32_t kept);

//% endif
/* Takes the next tick, and writes ${angle.column} in counts of ${angle.scale|decimal}
 * ${angle.unit}, within ${"%.12f"|format(angle.error|float)} counts of the exact model.
 * Returns whether there is an angle; else 0 is written. Call it at every tick: one
 * without a message is a sample of missing counts. */
bool ${prefix}_step(${prefix}_state *state, const ${prefix}_sample *sample, int32_t *angle);

/* How often each input was there, but beyond its range. Begin with zeros. */
typedef struct {
//% for field in fields.signals
    uint32_t ${field};
//% endfor
} ${prefix}_outside;

/* Counts what a tick has beyond the ranges; no angle depends on it. */
static inline void ${prefix}_count_outside(${prefix}_outside *outside, const ${prefix}_sample *sample)
{
//% for field, beyond in outside.items()
    if ((sample->${field} != INT16_MIN) && (${beyond}) && (outside->${field} < UINT32_MAX)) {
        outside->${field}++;
    }
//% else
    (void)outside;
    (void)sample;
//% endfor
}

#ifdef __cplusplus
}
#endif

#endif
