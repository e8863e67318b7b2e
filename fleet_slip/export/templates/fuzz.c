/* Fuzz target of ${version.reference}: clang -fsanitize=fuzzer,address,undefined */
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#include "${prefix}.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static ${prefix}_state state;
    ${prefix}_sample sample;
    size_t at = 0U;
//% if has_car
    ${prefix}_car car;
    if (size < sizeof car) { return 0; }
    (void)memcpy(&car, data, sizeof car);
    at = sizeof car;
//% endif
    ${prefix}_start(&state${", &car" if has_car});
    for (; (size - at) >= sizeof sample; at += sizeof sample) {
        int32_t angle;
        (void)memcpy(&sample, &data[at], sizeof sample);
        if ((!${prefix}_step(&state, &sample, &angle)) && (angle != 0)) {
            abort(); /* 0 without an angle */
        }
    }
    return 0;
}
