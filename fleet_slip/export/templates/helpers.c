/* Functions of exported estimators. An export contains those that it calls. */

//: within
/* Returns MISSING for a value outside a range. */
static int32_t within(int32_t value, int32_t low, int32_t high)
{
    return ((value < low) || (value > high)) ? MISSING : value;
}

//: clip
static int32_t clip(int64_t value, int32_t limit)
{
    const int64_t bound = limit;
    return (value > bound) ? limit : ((value < -bound) ? -limit : (int32_t)value);
}

//: clip_64
static int64_t clip_64(int64_t value, int64_t limit)
{
    return (value > limit) ? limit : ((value < -limit) ? -limit : value);
}

//: shift
/* Value over a power of two to the nearest integer, halves away from zero. */
static int64_t shifted(int64_t value, uint32_t bits)
{
    const uint64_t size = (uint64_t)((value < 0) ? -value : value);
    const int64_t result = (int64_t)((size + ((uint64_t)1U << (bits - 1U))) >> bits);
    return (value < 0) ? -result : result;
}

//: sign
static int32_t sign(int64_t value)
{
    int32_t result = 0;
    if (value > 0) {
        result = 1;
    } else if (value < 0) {
        result = -1;
    } else {
        /* zero */
    }
    return result;
}

//: min
static int32_t smaller(int32_t a, int32_t b)
{
    return (a < b) ? a : b;
}

//: max
static int32_t larger(int32_t a, int32_t b)
{
    return (a > b) ? a : b;
}

//: min_64
static int64_t smaller_64(int64_t a, int64_t b)
{
    return (a < b) ? a : b;
}

//: max_64
static int64_t larger_64(int64_t a, int64_t b)
{
    return (a > b) ? a : b;
}

//: power
/* The smallest power of two p, at least 1, with value <= factor * p. */
static int32_t power_of_two(int64_t value, int32_t factor)
{
    int64_t result = 1;
    for (uint32_t bit = 0U; (bit < 31U) && (value > (result * factor)); bit++) {
        result *= 2;
    }
    return (int32_t)result;
}

//: nearest_64
/* Quotient to the nearest integer, halves away from zero. */
static int64_t nearest_64(int64_t value, int64_t divisor)
{
    const int64_t size = (value < 0) ? -value : value;
    const int64_t result = ((2 * size) + divisor) / (2 * divisor);
    return (value < 0) ? -result : result;
}

//: nearest_32
/* Quotient of 32 bits to the nearest integer, halves away from zero. */
static int32_t nearest_32(int32_t value, uint32_t divisor)
{
    const uint32_t size = (uint32_t)((value < 0) ? -value : value);
    const uint32_t result = ((2U * size) + divisor) / (2U * divisor);
    return (value < 0) ? -(int32_t)result : (int32_t)result;
}

//: ago_16
/* Value of some ticks ago in a ring; at is the index of the next value. */
static int32_t ago_16(const int16_t *ring, uint32_t at, uint32_t length, uint32_t ticks)
{
    const uint32_t turn = (at >= ticks) ? 0U : length;
    const int16_t value = ring[(at + turn) - ticks];
    return (value == INT16_MIN) ? MISSING : (int32_t)value;
}

//: ago_32
/* Value of some ticks ago in a ring; at is the index of the next value. */
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
/* Removes the oldest value of a window and adds the newest. */
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
/* Removes the oldest value of a window and adds the newest. */
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
/* Adds a value to the sum since the start of a drive, unless it has the maximum number of values. */
static void gather(int64_t *sum, uint32_t *values, uint32_t limit, int32_t value)
{
    if ((value != MISSING) && (*values < limit)) {
        *sum += value;
        *values += 1U;
    }
}

//: floor_shift
/* value / 2^bits, rounded down. C does not define the shift of a negative number. */
static int64_t floor_shift(int64_t value, uint32_t bits)
{
    const uint64_t size = (uint64_t)((value >= 0) ? value : (-1 - value)) >> bits;
    return (value >= 0) ? (int64_t)size : (-1 - (int64_t)size);
}
