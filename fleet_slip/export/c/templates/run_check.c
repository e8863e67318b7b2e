static uint32_t run_${number}(void)
{
    static ${prefix}_state state;
    ${prefix}_sample sample;
${car}    uint32_t wrong = 0U;
    ${prefix}_start(&state${given});
    for (uint32_t i = 0U; i < ${ticks}U; i++) {
        int32_t angle;
${takes}
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
