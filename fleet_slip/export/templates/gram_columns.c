/* Writes the columns of a message, one bit each; returns the next index. */
static uint32_t put_columns(uint8_t *message, uint32_t at, uint32_t set, uint32_t mask)
{
    static const uint16_t positions[${places|length}] = {${places|join("U, ")}U};
    static const uint32_t first_position[SETS] = {${firsts|join("U, ")}U};
    for (uint32_t i = 0U; i < ${columns_bytes}U; i++) {
        message[at + i] = 0U;
    }
    for (uint32_t i = 0U; i < counted[set].columns; i++) {
        if (((mask >> i) & 1U) != 0U) {
            const uint32_t position = positions[first_position[set] + i];
            const uint32_t bit = (uint32_t)1U << (position % 8U);
            message[at + (position / 8U)] = (uint8_t)(message[at + (position / 8U)] | bit);
        }
    }
    return at + ${columns_bytes}U;
}

/* Signals of a message of the first set; time and delay of another set. */
static uint64_t contents_of(const ${prefix}_gram *gram, uint32_t set, const ${prefix}_gram_block *block)
{
    static const bool in_time[SETS] = {${sets|map(attribute="counted.in_time")|map("lower")|join(", ")}};
    const uint32_t delay = in_time[set] ? ((uint32_t)gram->delay & 0xFFFFU) : 0U;
    return (set == 0U) ? (uint64_t)block->mask : ((uint64_t)block->over | ((uint64_t)delay << 16U));
}

