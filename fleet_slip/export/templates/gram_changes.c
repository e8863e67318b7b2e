#define CHANGED ${changed|length}U
#define MAX_TIMES ${max_times}U
#define MAX_COLUMNS ${max_columns}U
#define HISTORY ${history}U
#define TURN INT64_C(${units.turn})
#define COURSE_COUNTS INT64_C(${2 * half_turn})
#define DIVISOR INT64_C(${units.divisor})
#define MAX_REMAINDER INT64_C(${units.largest})
#define SLOW ${units.slow}
#define STRAIGHT ${units.unturned}
#define COARSER ${coarser}
#define DELAY_PARTS ${delay_parts}
#define ROUND_DELAY ${delay_parts // 2}
#define MAX_ADVANCE ${0 - min_delay}
#define GAIN INT64_C(${4 * half_turn // delay_parts})

/* Changes of the columns of a feature set. */
typedef struct {
    uint32_t set;
    uint32_t columns;
    uint32_t length; /* ticks of stored columns */
    uint32_t times;
    uint32_t apart[MAX_TIMES]; /* ticks between two fixes, for each time */
} changed_set;

static const changed_set changed[CHANGED] = {
//% for number, one in changed
    {${number}U, ${one.computed|length}U, ${one.history_ticks}U, ${one.counted.times|length}U, {${one.counted.times|map("string")|join("U, ")}U}}${"," if not loop.last}
//% endfor
};

/* Index of the value of some ticks ago in a ring. */
static uint32_t ring_index(uint32_t newest, uint32_t length, uint32_t ago)
{
    const uint32_t turn = (newest >= ago) ? 0U : length;
    return (newest + turn) - ago;
}

/* Stores course and yaw rate of a tick. */
static void store_motion(${prefix}_gram *gram, int32_t course, int32_t yaw_rate)
{
    const ${prefix}_gram_motion *const last = &gram->history[gram->at];
    const bool present = (yaw_rate != MISSING);
    const uint32_t turned = last->turned + (present ? (uint32_t)yaw_rate : 0U);
    const uint32_t run = present ? (last->run + ((last->run < UINT32_MAX) ? 1U : 0U)) : 0U;
    gram->at = ((gram->at + 1U) == HISTORY) ? 0U : (gram->at + 1U);
    gram->history[gram->at].course = course;
    gram->history[gram->at].yaw_rate = present ? yaw_rate : 0;
    gram->history[gram->at].turned = turned;
    gram->history[gram->at].run = run;
}

/* Twice the integral of the yaw rate by trapezoids. Sums wrap, but their difference is small. */
static int64_t turned_between(const ${prefix}_gram_motion *now, const ${prefix}_gram_motion *before)
{
    const uint32_t sum = now->turned - before->turned;
    const int64_t wrapped = (sum > (uint32_t)INT32_MAX) ? INT64_C(4294967296) : 0;
    return ((2 * ((int64_t)sum - wrapped)) - now->yaw_rate) + before->yaw_rate;
}

/* Counts the changes of columns between two fixes of some ticks ago. */
static void count_change(${prefix}_gram *gram, const changed_set *spec, const int32_t *ring,
                         uint32_t newest, uint32_t over, int64_t remainder, int64_t turned,
                         uint32_t now_ago)
{
    const uint32_t first = ring_index(newest, spec->length, now_ago + spec->apart[over]) * spec->columns;
    const uint32_t then = ring_index(newest, spec->length, now_ago) * spec->columns;
    const ${prefix}_gram_motion *const now = &gram->history[ring_index(gram->at, HISTORY, now_ago)];
    const ${prefix}_gram_motion *const before =
        &gram->history[ring_index(gram->at, HISTORY, now_ago + spec->apart[over])];
    const bool slow = (now->yaw_rate <= SLOW) && (now->yaw_rate >= -SLOW) &&
                      (before->yaw_rate <= SLOW) && (before->yaw_rate >= -SLOW) &&
                      (turned <= STRAIGHT) && (turned >= -STRAIGHT);
    const int32_t change = (int32_t)nearest_64(remainder, DIVISOR);
    int32_t row[MAX_COLUMNS];
    for (uint32_t i = 0U; i < spec->columns; i++) {
        const bool present = (ring[first + i] != MISSING) && (ring[then + i] != MISSING);
        row[i] = present ? (ring[then + i] - ring[first + i]) : MISSING;
    }
    row[spec->columns] = (int32_t)nearest_64(turned, COARSER);
    row[spec->columns + 1U] = 0;
    row[spec->columns + 2U] = 0;
    if (slow) {
        row[spec->columns + 1U] = 1;
        row[spec->columns + 2U] = change;
    }
    row[spec->columns + 3U] = change;
    count_row(gram, spec->set, over, row);
}

/* Counts the changes up to the time of the fix of this tick, if present is one. */
static void count_changes(${prefix}_gram *gram, const changed_set *spec, const int32_t *ring,
                          uint32_t newest, int32_t delay)
{
    const int32_t ticks = (((delay + ROUND_DELAY) + (DELAY_PARTS * MAX_ADVANCE)) / DELAY_PARTS) - MAX_ADVANCE;
    const int64_t gain = ((int64_t)delay - ((int64_t)ticks * DELAY_PARTS)) * GAIN;
    const uint32_t now_ago = (ticks > 0) ? (uint32_t)ticks : 0U;
    const uint32_t fix_ago = (ticks < 0) ? (uint32_t)(-ticks) : 0U;
    for (uint32_t over = 0U; over < spec->times; over++) {
        const uint32_t apart = spec->apart[over];
        const int32_t course = gram->history[ring_index(gram->at, HISTORY, fix_ago)].course;
        const int32_t from = gram->history[ring_index(gram->at, HISTORY, fix_ago + apart)].course;
        const ${prefix}_gram_motion *const now = &gram->history[ring_index(gram->at, HISTORY, now_ago)];
        const ${prefix}_gram_motion *const before =
            &gram->history[ring_index(gram->at, HISTORY, now_ago + apart)];
        if ((course != MISSING) && (from != MISSING) && (now->run > apart)) {
            const int64_t turned = turned_between(now, before);
            int64_t remainder = (TURN * ((int64_t)course - from)) - (COURSE_COUNTS * turned);
            remainder += gain * ((int64_t)now->yaw_rate - before->yaw_rate);
            remainder -= (COURSE_COUNTS * TURN) * nearest_64(remainder, COURSE_COUNTS * TURN);
            if ((remainder <= MAX_REMAINDER) && (remainder >= -MAX_REMAINDER)) {
                count_change(gram, spec, ring, newest, over, remainder, turned, now_ago);
            }
        }
    }
}

/* Stores the columns of a tick; returns their index. */
static uint32_t store_columns(const changed_set *spec, int32_t *ring, uint32_t newest,
                             const int32_t *columns)
{
    const uint32_t index = ((newest + 1U) == spec->length) ? 0U : (newest + 1U);
    for (uint32_t i = 0U; i < spec->columns; i++) {
        ring[(index * spec->columns) + i] = columns[i];
    }
    return index;
}

/* Counts a row without columns at the first tick, so that a drive without a course has a row. */
static void count_empty_row(${prefix}_gram *gram)
{
    for (uint32_t i = 0U; i < CHANGED; i++) {
        for (uint32_t over = 0U; over < changed[i].times; over++) {
            int32_t row[MAX_COLUMNS];
            for (uint32_t j = 0U; j < MAX_COLUMNS; j++) {
                row[j] = MISSING;
            }
            count_row(gram, changed[i].set, over, row);
        }
    }
}

