//% for name, value in constants.items()
#define ${name} ${value}
//% endfor
${""}
/* What the columns of a feature set change by. */
typedef struct {
    uint32_t set;
    uint32_t columns;
    uint32_t length; /* ticks of them that are kept */
    uint32_t times;
    uint32_t apart[MOST_TIMES]; /* ticks from one fix to another, of each time */
} changed_set;

static const changed_set changed[CHANGED] = {
//% for number, one in changed
    {${number}U, ${one.computed|length}U, ${one.kept_ticks}U, ${one.of.times|length}U, {${one.of.times|map("string")|join("U, ")}U}}${"," if not loop.last}
//% endfor
};

/* The place of so many ticks ago in a ring of so many, whose newest value is at a place. */
static uint32_t place_of(uint32_t newest, uint32_t length, uint32_t ago)
{
    const uint32_t turn = (newest >= ago) ? 0U : length;
    return (newest + turn) - ago;
}

/* Keeps course and yaw rate of a tick. */
static void keep_track(${prefix}_gram *gram, int32_t course, int32_t yaw_rate)
{
    const ${prefix}_gram_track *const last = &gram->track[gram->at];
    const bool there = (yaw_rate != MISSING);
    const uint32_t turned = last->turned + (there ? (uint32_t)yaw_rate : 0U);
    const uint32_t run = there ? (last->run + ((last->run < UINT32_MAX) ? 1U : 0U)) : 0U;
    gram->at = ((gram->at + 1U) == TRACK) ? 0U : (gram->at + 1U);
    gram->track[gram->at].course = course;
    gram->track[gram->at].yaw_rate = there ? yaw_rate : 0;
    gram->track[gram->at].turned = turned;
    gram->track[gram->at].run = run;
}

/* Twice the integral of the yaw rate, by trapezoids: sums wrap, their difference is small. */
static int64_t turned_between(const ${prefix}_gram_track *now, const ${prefix}_gram_track *before)
{
    const uint32_t sum = now->turned - before->turned;
    const int64_t wrapped = (sum > (uint32_t)INT32_MAX) ? INT64_C(4294967296) : 0;
    return ((2 * ((int64_t)sum - wrapped)) - now->yaw_rate) + before->yaw_rate;
}

/* Counts what columns changed by between two fixes, whose ticks are so many ago. */
static void count_change(${prefix}_gram *gram, const changed_set *of, const int32_t *ring,
                         uint32_t newest, uint32_t over, int64_t left, int64_t turned,
                         uint32_t now_ago)
{
    const uint32_t first = place_of(newest, of->length, now_ago + of->apart[over]) * of->columns;
    const uint32_t then = place_of(newest, of->length, now_ago) * of->columns;
    const ${prefix}_gram_track *const now = &gram->track[place_of(gram->at, TRACK, now_ago)];
    const ${prefix}_gram_track *const before =
        &gram->track[place_of(gram->at, TRACK, now_ago + of->apart[over])];
    const bool slow = (now->yaw_rate <= SLOW) && (now->yaw_rate >= -SLOW) &&
                      (before->yaw_rate <= SLOW) && (before->yaw_rate >= -SLOW) &&
                      (turned <= UNTURNED) && (turned >= -UNTURNED);
    const int32_t change = (int32_t)nearest_64(left, DIVISOR);
    int32_t row[MOST_COLUMNS];
    for (uint32_t i = 0U; i < of->columns; i++) {
        const bool there = (ring[first + i] != MISSING) && (ring[then + i] != MISSING);
        row[i] = there ? (ring[then + i] - ring[first + i]) : MISSING;
    }
    row[of->columns] = (int32_t)nearest_64(turned, COARSER);
    row[of->columns + 1U] = 0;
    row[of->columns + 2U] = 0;
    if (slow) {
        row[of->columns + 1U] = 1;
        row[of->columns + 2U] = change;
    }
    row[of->columns + 3U] = change;
    count_row(gram, of->set, over, row);
}

/* Counts the changes up to the fix of this tick, if there is one: of the moment that it is of. */
static void count_changes(${prefix}_gram *gram, const changed_set *of, const int32_t *ring,
                          uint32_t newest, int32_t late)
{
    const int32_t whole = (((late + ROUND_LATE) + (LATE_PARTS * EARLIEST)) / LATE_PARTS) - EARLIEST;
    const int64_t gain = ((int64_t)late - ((int64_t)whole * LATE_PARTS)) * GAIN;
    const uint32_t now_ago = (whole > 0) ? (uint32_t)whole : 0U;
    const uint32_t fix_ago = (whole < 0) ? (uint32_t)(-whole) : 0U;
    for (uint32_t over = 0U; over < of->times; over++) {
        const uint32_t apart = of->apart[over];
        const int32_t course = gram->track[place_of(gram->at, TRACK, fix_ago)].course;
        const int32_t from = gram->track[place_of(gram->at, TRACK, fix_ago + apart)].course;
        const ${prefix}_gram_track *const now = &gram->track[place_of(gram->at, TRACK, now_ago)];
        const ${prefix}_gram_track *const before =
            &gram->track[place_of(gram->at, TRACK, now_ago + apart)];
        if ((course != MISSING) && (from != MISSING) && (now->run > apart)) {
            const int64_t turned = turned_between(now, before);
            int64_t left = (TURN * ((int64_t)course - from)) - (COURSE_COUNTS * turned);
            left += gain * ((int64_t)now->yaw_rate - before->yaw_rate);
            left -= (COURSE_COUNTS * TURN) * nearest_64(left, COURSE_COUNTS * TURN);
            if ((left <= LARGEST) && (left >= -LARGEST)) {
                count_change(gram, of, ring, newest, over, left, turned, now_ago);
            }
        }
    }
}

/* Keeps the columns of a tick; returns where. */
static uint32_t keep_columns(const changed_set *of, int32_t *ring, uint32_t newest,
                             const int32_t *columns)
{
    const uint32_t place = ((newest + 1U) == of->length) ? 0U : (newest + 1U);
    for (uint32_t i = 0U; i < of->columns; i++) {
        ring[(place * of->columns) + i] = columns[i];
    }
    return place;
}

/* A drive's first tick has no change: so a drive without a course is known to have none. */
static void count_nothing(${prefix}_gram *gram)
{
    for (uint32_t i = 0U; i < CHANGED; i++) {
        for (uint32_t over = 0U; over < changed[i].times; over++) {
            int32_t row[MOST_COLUMNS];
            for (uint32_t j = 0U; j < MOST_COLUMNS; j++) {
                row[j] = MISSING;
            }
            count_row(gram, changed[i].set, over, row);
        }
    }
}

