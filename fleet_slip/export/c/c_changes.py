"""What counts changes of columns from fix to fix, in C99: rings, and what `gram.c` lacks for them.

A fix comes late: columns, course and yaw rate are kept of as many ticks as a change and a delay
take. A tick is counted once its fix is here, as `fleet_slip.grams.rows.course_sums` counts it.
"""

from collections.abc import Mapping, Sequence
from itertools import accumulate

from fleet_slip.catalogue.course_change import (
    BESIDE,
    COARSER,
    COURSE,
    LATE_PARTS,
    MOST_EARLY,
    MOST_LATE,
    YAW_RATE,
    course_units,
)
from fleet_slip.catalogue.signals import HALF_TURN, SAMPLE_TIME_S
from fleet_slip.export.c.c_names import INDENT, array_of, indented, read_template, table_of
from fleet_slip.export.c.c_source import keep_lines, sample_lines, start_lines
from fleet_slip.export.c.c_steps import StepWriter, state_fields
from fleet_slip.export.c.on_board import OnBoard
from fleet_slip.export.program import Steps
from fleet_slip.grams.received.messages import LAYOUT, MOST_COLUMNS, SET_LAYOUT

Changed = Sequence[tuple[int, OnBoard]]
"""The sets of changes, and which of all sets each is."""


def words_of_sets(
    prefix: str,
    steps: Steps,
    writer: StepWriter,
    places: Mapping[str, int],
    sets: Sequence[OnBoard],
) -> dict[str, str]:
    """Return the words of `gram.h` and `gram.c` that count other sets than the logged signals."""
    changed = [(number, one) for number, one in enumerate(sets) if one.of.times]
    track = max(_kept_ticks(one) for _, one in changed)
    tick = _tick(prefix, writer, places, sets, changed)
    return {
        "missing": "INT32_MIN",
        "fields": indented(sample_lines(steps, "int32_t")).rstrip("\n"),
        "track_type": _TRACK.replace("PREFIX", prefix),
        "state": indented(_state(prefix, steps, changed, track)),
        "start_comment": _LATE,
        "late": ", int32_t late",
        "otherwise": "pass it over",
        "pass": _OVER.replace("PREFIX", prefix),
        "changes": _changes(prefix, changed, track),
        "start": indented(_start(prefix, steps, writer, changed)),
        "tick": tick,
        "columns_bits": _columns_bits(prefix, sets),
        "layout": f"(set == 0U) ? {LAYOUT}U : {SET_LAYOUT}U",
        "which": "which_of(gram, set, from)",
        "columns": indented(
            ["if (set > 0U) {", f"{INDENT}at = put_columns(message, at, set, from->mask);", "}"]
        ),
    }


_TRACK = """
/* Course and yaw rate of a tick; the sum of the yaw rate, and for how many ticks it was there. */
typedef struct {
    int32_t course;
    int32_t yaw_rate;
    uint32_t turned;
    uint32_t run;
} PREFIX_gram_track;
"""

_OVER = """
/* Passes over a tick that was not logged. */
void PREFIX_gram_pass(PREFIX_gram *gram);
"""

_LATE = (
    f" late is the delay of the course in {1000 * float(SAMPLE_TIME_S) / LATE_PARTS:g} ms, from\n"
    f" * {LATE_PARTS * MOST_EARLY} to {LATE_PARTS * MOST_LATE}; 0 where it is not known."
)


def _kept_ticks(one: OnBoard) -> int:
    """Return of how many ticks columns are kept: of a change, and of a fix that is late."""
    return max(one.of.times) + 1 + (MOST_LATE if one.of.in_time else 0)


def _state(prefix: str, steps: Steps, changed: Changed, track: int) -> list[str]:
    """Return the fields of what is kept from tick to tick."""
    lines = [field.declared for field in state_fields(steps) if field.name != "nothing"]
    for number, one in changed:
        lines += [
            f"int32_t columns_{number}[{_kept_ticks(one) * len(one.computed)}];",
            f"uint32_t at_columns_{number};",
        ]
    return [
        *lines,
        f"{prefix}_gram_track track[{track}];",
        "uint32_t at;",
        "int32_t late;",
        "bool began;",
    ]


def _start(prefix: str, steps: Steps, writer: StepWriter, changed: Changed) -> list[str]:
    """Return the statements that begin a drive, beside those of the counts."""
    lines = _with_state(prefix, start_lines(steps, writer))
    least, most = LATE_PARTS * MOST_EARLY, LATE_PARTS * MOST_LATE
    return [
        *lines,
        *(f"gram->at_columns_{number} = 0U;" for number, _ in changed),
        "for (uint32_t i = 0U; i < TRACK; i++) {",
        f"{INDENT}gram->track[i].course = MISSING;",
        f"{INDENT}gram->track[i].yaw_rate = 0;",
        f"{INDENT}gram->track[i].turned = 0U;",
        f"{INDENT}gram->track[i].run = 0U;",
        "}",
        "gram->at = 0U;",
        f"gram->late = (late < ({least})) ? ({least}) : ((late > {most}) ? {most} : late);",
        "gram->began = false;",
    ]


def _with_state(prefix: str, lines: list[str]) -> list[str]:
    """Return statements of steps, whose state is part of what is counted."""
    if not any("state->" in line for line in lines):
        return lines
    return [f"{prefix}_gram *const state = gram;", *lines]


def _changes(prefix: str, changed: Changed, track: int) -> str:
    """Return the functions that count changes."""
    units = course_units()
    most_times = max(len(one.of.times) for _, one in changed)
    numbers = {
        "CHANGED": f"{len(changed)}U",
        "MOST_TIMES": f"{most_times}U",
        "MOST_COLUMNS": f"{max(len(one.computed) for _, one in changed) + len(BESIDE) + 1}U",
        "TRACK": f"{track}U",
        "TURN": f"INT64_C({units.turn})",
        "COURSE_COUNTS": f"INT64_C({2 * HALF_TURN})",
        "DIVISOR": f"INT64_C({units.divisor})",
        "LARGEST": f"INT64_C({units.largest})",
        "SLOW": str(units.slow),
        "UNTURNED": str(units.unturned),
        "COARSER": str(COARSER),
        "LATE_PARTS": str(LATE_PARTS),
        "ROUND_LATE": str(LATE_PARTS // 2),
        "EARLIEST": str(-MOST_EARLY),
        "GAIN": f"INT64_C({4 * HALF_TURN // LATE_PARTS})",
    }
    rows = [
        [
            f"{number}U",
            f"{len(one.computed)}U",
            f"{_kept_ticks(one)}U",
            f"{len(one.of.times)}U",
            f"{{{', '.join(f'{ticks}U' for ticks in one.of.times)}}}",
        ]
        for number, one in changed
    ]
    defined = "\n".join(f"#define {name} {value}" for name, value in numbers.items())
    functions = read_template("gram_changes.c").substitute(prefix=prefix, changed=table_of(rows))
    return f"\n{defined}\n\n{functions}"


def _tick(
    prefix: str,
    writer: StepWriter,
    places: Mapping[str, int],
    sets: Sequence[OnBoard],
    changed: Changed,
) -> str:
    """Return the functions that take a tick, logged or not."""
    rows = {
        number: [writer.kept(places[name]) for name in one.computed]
        for number, one in enumerate(sets)
    }
    course, yaw_rate = (writer.kept(places[name]) for name in (COURSE, YAW_RATE))
    keeps = keep_lines(writer.program, writer)
    writer.done["nearest_64"] += 1
    logged: list[str] = ["if (!gram->began) {", f"{INDENT}count_nothing(gram);", "}"]
    for number, one in enumerate(sets):
        if not one.of.times:
            logged += array_of(f"row_{number}", rows[number])
            logged.append(f"count_row(gram, {number}U, 0U, row_{number});")
    lines = [*writer.lines, *keeps, "if (logged) {", *(INDENT + line for line in logged), "}"]
    lines += ["gram->began = true;", f"keep_track(gram, {course}, {yaw_rate});"]
    for place, (number, one) in enumerate(changed):
        ring, at, of = f"gram->columns_{number}", f"gram->at_columns_{number}", f"&changed[{place}]"
        lines += array_of(f"row_{number}", rows[number], "const int32_t")
        lines += [
            f"{at} = keep_columns({of}, {ring}, {at}, row_{number});",
            f"count_changes(gram, {of}, {ring}, {at}, {'gram->late' if one.of.in_time else '0'});",
        ]
    lines = _with_state(prefix, lines)
    given = f"{prefix}_gram *gram, const {prefix}_gram_sample *sample"
    nothing = ", ".join(["MISSING"] * len(writer.program.signals))
    return (
        f"\nstatic void take_tick({given}, bool logged)\n{{\n{indented(lines)}}}\n"
        f"\nvoid {prefix}_gram_add({given})\n{{\n"
        f"{indented(['take_tick(gram, sample, true);'])}}}\n"
        f"\nvoid {prefix}_gram_pass({prefix}_gram *gram)\n{{\n"
        f"{INDENT}const {prefix}_gram_sample nothing = {{{nothing}}};\n"
        f"{indented(['take_tick(gram, &nothing, false);'])}}}\n"
    )


def _columns_bits(prefix: str, sets: Sequence[OnBoard]) -> str:
    """Return the functions that say which columns of its set a message is of."""
    numbers = [place for one in sets for place in one.places]
    firsts = accumulate((len(one.columns) for one in sets), initial=0)
    in_time = ["true" if one.of.in_time else "false" for one in sets]
    return read_template("gram_columns.c").substitute(
        prefix=prefix,
        columns_bytes=MOST_COLUMNS // 8,
        all_columns=len(numbers),
        places=", ".join(f"{number}U" for number in numbers),
        firsts=", ".join(f"{first}U" for first, _ in zip(firsts, sets, strict=False)),
        in_time=", ".join(in_time),
    )
