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

/* Missing count. A count outside its range is missing, too. */
#define ${upper}_MISSING INT16_MIN

/* Counts of one tick: physical = scale * count. */
typedef struct {
//% set kind = "int16_t"
//% include "templates/sample.h"
} ${prefix}_sample;

//% if has_car
/* Unknown property of the car. */
#define ${upper}_UNKNOWN INT32_MIN

/* Properties of the car. */
typedef struct {
//% for one, field in zip(program.facts, fields.facts)
    int32_t ${field}; /* ${"whole number" if one.equals is none else "1 or 0"} */
//% endfor
//% for one, field in zip(program.numbers, fields.numbers)
    int32_t ${field}; /* ${one.grain|decimal} ${one.unit|unit} */
//% endfor
} ${prefix}_car;

//% endif
/* State between two ticks. */
typedef struct {
//% for one in state
    ${one.declared}
//% endfor
} ${prefix}_state;

/* Starts a drive. */
void ${prefix}_start(${prefix}_state *state${", const " ~ prefix ~ "_car *car" if has_car});

//% if program.learned
/* Starts another drive of the same car and retains a share (retained / 256) of the sums from which it
 * learns load and tyres. Keep the state in non-volatile memory between the drives. */
void ${prefix}_next(${prefix}_state *state, ${"const " ~ prefix ~ "_car *car, " if has_car}uint32_t retained);

//% endif
/* Computes ${angle.column} at the next tick, in counts of ${angle.scale|decimal} ${angle.unit},
 * within ${"%.12f"|format(angle.error|float)} counts of the exact model. Returns false and writes 0
 * if there is no angle. Call it at every tick, without a message with missing counts. */
bool ${prefix}_step(${prefix}_state *state, const ${prefix}_sample *sample, int32_t *angle);

/* Number of counts outside the range, for each input. Initialise it with zeros. */
typedef struct {
//% for field in fields.signals
    uint32_t ${field};
//% endfor
} ${prefix}_outside;

/* Counts the inputs of a tick that are outside their ranges. The angle does not depend on it. */
static inline void ${prefix}_count_outside(${prefix}_outside *outside, const ${prefix}_sample *sample)
{
//% for field, condition in outside.items()
    if ((sample->${field} != INT16_MIN) && (${condition}) && (outside->${field} < UINT32_MAX)) {
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
