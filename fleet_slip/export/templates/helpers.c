/* The functions that an exported estimator is made of; each is written where it is called. */

//: within
/* A value of a range; MISSING beyond it. */
static int32_t within(int32_t value, int32_t least, int32_t most)
{
    return ((value < least) || (value > most)) ? MISSING : value;
}

//: clip
static int32_t clip(int64_t value, int32_t limit)
{
    const int64_t most = limit;
    return (value > most) ? limit : ((value < -most) ? -limit : (int32_t)value);
}

//: sign
static int32_t sign(int64_t value)
{
    int32_t found = 0;
    if (value > 0) {
        found = 1;
    } else if (value < 0) {
        found = -1;
    } else {
        /* zero */
    }
    return found;
}

//: min
static int32_t smaller(int32_t one, int32_t other)
{
    return (one < other) ? one : other;
}

//: max
static int32_t larger(int32_t one, int32_t other)
{
    return (one > other) ? one : other;
}

//: max_64
static int64_t larger_64(int64_t one, int64_t other)
{
    return (one > other) ? one : other;
}

//: power
/* The least power of two, at least 1, times which most is not below a value. */
static int32_t power_of_two(int64_t value, int32_t most)
{
    int64_t found = 1;
    for (uint32_t bit = 0U; (bit < 31U) && (value > (found * most)); bit++) {
        found *= 2;
    }
    return (int32_t)found;
}

//: nearest_64
/* value / divisor to the nearest, halves away from zero. */
static int64_t nearest_64(int64_t value, int64_t divisor)
{
    const int64_t size = (value < 0) ? -value : value;
    const int64_t found = ((2 * size) + divisor) / (2 * divisor);
    return (value < 0) ? -found : found;
}

//: nearest_32
/* The same for what fits into 32 bits. */
static int32_t nearest_32(int32_t value, uint32_t divisor)
{
    const uint32_t size = (uint32_t)((value < 0) ? -value : value);
    const uint32_t found = ((2U * size) + divisor) / (2U * divisor);
    return (value < 0) ? -(int32_t)found : (int32_t)found;
}

//: ago_16
/* The value of so many ticks ago; at is where the next one will be written. */
static int32_t ago_16(const int16_t *ring, uint32_t at, uint32_t length, uint32_t ticks)
{
    const uint32_t turn = (at >= ticks) ? 0U : length;
    const int16_t value = ring[(at + turn) - ticks];
    return (value == INT16_MIN) ? MISSING : (int32_t)value;
}

//: ago_32
/* The value of so many ticks ago; at is where the next one will be written. */
static int32_t ago_32(const int32_t *ring, uint32_t at, uint32_t length, uint32_t ticks)
{
    const uint32_t turn = (at >= ticks) ? 0U : length;
    return ring[(at + turn) - ticks];
}

//: keep_16
static void keep_16(int16_t *ring, uint32_t *at, uint32_t length, int32_t value)
{
    ring[*at] = (value == MISSING) ? INT16_MIN : (int16_t)value;
    *at = ((*at + 1U) == length) ? 0U : (*at + 1U);
}

//: keep_32
static void keep_32(int32_t *ring, uint32_t *at, uint32_t length, int32_t value)
{
    ring[*at] = value;
    *at = ((*at + 1U) == length) ? 0U : (*at + 1U);
}

//: slide_32
/* The oldest value leaves a window, the newest comes. */
static void slide_32(int32_t *sum, uint32_t *values, int32_t oldest, int32_t newest)
{
    if (oldest != MISSING) {
        *sum -= oldest;
        *values -= 1U;
    }
    if (newest != MISSING) {
        *sum += newest;
        *values += 1U;
    }
}

//: slide_64
/* The oldest value leaves a window, the newest comes. */
static void slide_64(int64_t *sum, uint32_t *values, int32_t oldest, int32_t newest)
{
    if (oldest != MISSING) {
        *sum -= oldest;
        *values -= 1U;
    }
    if (newest != MISSING) {
        *sum += newest;
        *values += 1U;
    }
}

//: gather
/* A value comes to all since the drive began, unless its sum could overflow. */
static void gather(int64_t *sum, uint32_t *values, uint32_t most, int32_t value)
{
    if ((value != MISSING) && (*values < most)) {
        *sum += value;
        *values += 1U;
    }
}

//: floor_shift
/* value / 2^bits, rounded down: a negative number is not shifted, which C leaves open. */
static int64_t floor_shift(int64_t value, uint32_t bits)
{
    const uint64_t size = (uint64_t)((value >= 0) ? value : (-1 - value)) >> bits;
    return (value >= 0) ? (int64_t)size : (-1 - (int64_t)size);
}
