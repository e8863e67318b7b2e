//% include "templates/preamble.h"
#include "${prefix}.h"

#define MISSING INT32_MIN

//% for helper in helpers
${helper}
//% endfor
void ${prefix}_start(${prefix}_state *state${", const " ~ prefix ~ "_car *car" if has_car})
{
//% for line in start
    ${line}
//% endfor
}

//% if learned
void ${prefix}_next(${prefix}_state *state, ${"const " ~ prefix ~ "_car *car, " if has_car}uint32_t retained)
{
    const uint32_t parts = (retained < 256U) ? retained : 256U;
//% for key in learned
    const int64_t sum_${key} = floor_shift(state->sum_${key} * (int64_t)parts, 8U);
    const uint64_t values_${key} = ((uint64_t)state->values_${key} * parts) / 256U;
//% endfor
    ${prefix}_start(state${", car" if has_car});
//% for key in learned
    state->sum_${key} = sum_${key};
    state->values_${key} = (uint32_t)values_${key};
//% endfor
}

//% endif
bool ${prefix}_step(${prefix}_state *state, const ${prefix}_sample *sample, int32_t *angle)
{
    /* Coefficients over 2^${angle.bits}: upper * 2^${angle.low_bits} + lower. */
//% for name in ("upper", "lower")
//% set which = loop.index0
    static const int32_t ${name}[${terms|length}] = {
//% for row in angle.parts[1:]|batch(6)
        ${row|map(attribute=which)|join(", ")}${"," if not loop.last}
//% endfor
    };
//% endfor
//% for line in lines
    ${line}
//% endfor
    const ${kind} term[${terms|length}] = {
//% for term in terms
        ${term}${"," if not loop.last}
//% endfor
    };
    int64_t high = ${angle.parts[0][0]|literal};
    int64_t low = ${angle.parts[0][1]|literal};
    for (uint32_t i = 0U; i < ${terms|length}U; i++) {
        high += (int64_t)upper[i] * term[i];
        low += (int64_t)lower[i] * term[i];
    }
    high += floor_shift(low, ${angle.low_bits}U) + ${(2 ** (shift - 1))|literal};
    const bool valid = ${valid};
    *angle = valid ? clip(floor_shift(high, ${shift}U), ${angle.limit}) : 0;
//% if not looks_back
    (void)state;
//% endif
    return valid;
}
