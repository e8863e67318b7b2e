"""Checks the order of time and cuts a file into drives, each one uninterrupted stretch."""

import polars as pl

from fleet_slip.ingest.mapping import TimeBase
from fleet_slip.ingest.quarantine import no_rows
from fleet_slip.ingest.resampling import STEP_S, TIME_EPSILON_S


def cut_into_drives(rows: pl.DataFrame, base: TimeBase) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Sort rows by drive and number the drives in a column `part`; return the bad rows apart.

    Within the rows of one `group`, in the file's order:

    * a step in time larger than `split_gap_s`, forward or back, begins a new part;
    * `isolated`: a row whose neighbours are both that far; it goes before parts are made, so one
      wild time stamp costs one row and does not cut a drive;
    * `time_duplicate`, `time_backwards`: not later than all earlier rows of its part;
    * `too_short`: its part lasts less than one sample time.

    Rows of several time bases are sorted by time instead; their order was looked at base by base.
    """
    several = "base" in rows.columns
    if several:
        rows = rows.sort("group", "time", maintain_order=True)
    elif not rows["group"].is_sorted():
        rows = rows.sort("group", maintain_order=True)
    far = _is_far(base.split_gap_s)
    alone = far & far.shift(-1, fill_value=True)
    rows, isolated = _quarantine(rows, pl.when(alone).then(pl.lit("isolated")))
    rows = rows.with_columns(far.cum_sum().alias("part"))
    disordered = no_rows()
    if not several:
        before = pl.col("time").cum_max().shift(1).over("part")
        duplicate = pl.when(pl.col("time") == before).then(pl.lit("time_duplicate"))
        backwards = pl.when(pl.col("time") < before).then(pl.lit("time_backwards"))
        rows, disordered = _quarantine(rows, pl.coalesce(duplicate, backwards))
    duration = (pl.col("time").last() - pl.col("time").first()).over("part")
    short = pl.when(duration < STEP_S - TIME_EPSILON_S).then(pl.lit("too_short"))
    rows, shorts = _quarantine(rows, short)
    return rows, pl.concat([isolated, disordered, shorts])


def sample_interval_s(rows: pl.DataFrame) -> float:
    """Return the usual time between two rows of a drive: the median over the file."""
    step = rows.select(pl.col("time").diff().filter(pl.col("part").diff() == 0))
    median = step["time"].median()
    return float(median) if isinstance(median, float) else STEP_S


def sample_intervals_s(rows: pl.DataFrame) -> dict[int, float]:
    """Return the usual time between two rows of each time base; the only one is number 0."""
    if "base" not in rows.columns:
        return {0: sample_interval_s(rows)}
    bases = rows.partition_by("base", as_dict=True)
    return {number: sample_interval_s(base) for (number,), base in bases.items()}


def _is_far(split_gap_s: float) -> pl.Expr:
    """Whether a row is the first of its group or further than the gap from the row before."""
    first = pl.col("group") != pl.col("group").shift(1)
    step = pl.col("time").diff().abs() > split_gap_s + TIME_EPSILON_S
    return (first | step).fill_null(value=True)


def _quarantine(rows: pl.DataFrame, reason: pl.Expr) -> tuple[pl.DataFrame, pl.DataFrame]:
    rows = rows.with_columns(reason.alias("reason"))
    bad = rows.filter(pl.col("reason").is_not_null())
    bad = bad.select(
        "row",
        "group",
        "reason",
        pl.lit("time").alias("signal"),
        pl.col("time").cast(pl.String).alias("value"),
    )
    good = (
        rows.filter(pl.col("reason").is_null()).drop("reason")
        if bad.height
        else rows.drop("reason")
    )
    return good, pl.concat([no_rows(), bad])
