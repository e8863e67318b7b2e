/* Self-test of ${version.reference}. It prints its result only. */
#include <stdio.h>

#include "${prefix}.h"

#define NO_ANGLE INT32_MIN

//% for check in checks
/* ${check.name|plain} */
static const int16_t samples_${loop.index0}[${check.samples|length}][${fields.signals|length}] = {
//% for sample in check.samples
    {${sample|map("word")|join(", ")}}${"," if not loop.last}
//% endfor
};

static const int32_t angles_${loop.index0}[${check.angles|length}] = {
    ${check.angles|map("or_missing", "NO_ANGLE")|join(", ")}
};

//% endfor
//% for check in checks
//% set number = loop.index0
static uint32_t run_${number}(void)
{
    static ${prefix}_state state;
    ${prefix}_sample sample;
//% if has_car
    const ${prefix}_car car = { ${(check.facts + check.numbers)|map("or_missing", "INT32_MIN")|join(", ")} };
//% endif
    uint32_t wrong = 0U;
    ${prefix}_start(&state${", &car" if has_car});
    for (uint32_t i = 0U; i < ${check.angles|length}U; i++) {
        int32_t angle;
//% for field in fields.signals
        sample.${field} = samples_${number}[i][${loop.index0}];
//% endfor
        const bool valid = ${prefix}_step(&state, &sample, &angle);
        const int32_t expected = angles_${number}[i];
        if (valid != (expected != NO_ANGLE)) {
            wrong += 1U;
        } else if (valid && (angle != expected)) {
            wrong += 1U;
        } else {
            /* right */
        }
    }
    return wrong;
}

//% endfor
int main(void)
{
    uint32_t wrong = 0U;
//% for check in checks
    wrong += run_${loop.index0}();
//% endfor
    (void)printf("${version.reference}: %lu of ${total} angles are wrong\n", (unsigned long)wrong);
    return (wrong == 0U) ? 0 : 1;
}
