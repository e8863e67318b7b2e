/* Writes which columns of its set a message is of; returns where the next number goes. */
static uint32_t put_columns(uint8_t *message, uint32_t at, uint32_t set, uint32_t mask)
{
    static const uint16_t places[${places|length}] = {${places|join("U, ")}U};
    static const uint32_t first_place[SETS] = {${firsts|join("U, ")}U};
    for (uint32_t i = 0U; i < ${columns_bytes}U; i++) {
        message[at + i] = 0U;
    }
    for (uint32_t i = 0U; i < counted[set].columns; i++) {
        if (((mask >> i) & 1U) != 0U) {
            const uint32_t place = places[first_place[set] + i];
            const uint32_t bit = (uint32_t)1U << (place % 8U);
            message[at + (place / 8U)] = (uint8_t)(message[at + (place / 8U)] | bit);
        }
    }
    return at + ${columns_bytes}U;
}

/* Which signals a message is of; of another set, which time and delay. */
static uint64_t which_of(const ${prefix}_gram *gram, uint32_t set, const ${prefix}_gram_part *part)
{
    static const bool in_time[SETS] = {${sets|map(attribute="of.in_time")|map("lower")|join(", ")}};
    const uint32_t late = in_time[set] ? ((uint32_t)gram->late & 0xFFFFU) : 0U;
    return (set == 0U) ? (uint64_t)part->mask : ((uint64_t)part->over | ((uint64_t)late << 16U));
}

