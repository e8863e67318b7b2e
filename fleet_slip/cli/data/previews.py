"""Shows what `ingest --dry-run` found."""

from pathlib import Path

from fleet_slip.cli.output import print_json, print_table, print_text, say
from fleet_slip.errors import AlarmError
from fleet_slip.ingest.drafting.preview import Preview, draw_preview
from fleet_slip.words import number_of


def show_previews(previews: list[Preview], plot: Path | None, json: bool) -> None:
    """Print previews, and draw the only one. Raises `AlarmError` if anything looks wrong."""
    if plot is not None:
        draw_preview(previews[0], plot)
        say(f"drawn to {plot}")
    if json:
        print_json(previews)
    else:
        for preview in previews:
            _show(preview)
    suspicions = sum(len(preview.suspicions) for preview in previews)
    if suspicions:
        raise AlarmError(
            f"{number_of(suspicions, 'thing')} to look at before ingesting. Nothing was stored."
        )


def _show(preview: Preview) -> None:
    counts = preview.counts
    rejected = ", ".join(f"{n:,} {reason}" for reason, n in counts.quarantined.items())
    print_table(
        f"{preview.file}: {number_of(counts.rows_read, 'row')}; left out by conditions "
        f"{counts.rows_left_out:,}; rejected {sum(counts.quarantined.values()):,}"
        f"{f' ({rejected})' if rejected else ''}; {number_of(counts.drives, 'drive')} of "
        f"{number_of(counts.ticks, 'tick')}",
        ["signal", "unit", "least", "most", "missing"],
        [
            [one.signal, one.unit, f"{one.low:.4g}", f"{one.high:.4g}", f"{one.missing:.1%}"]
            for one in preview.ranges
        ],
        left=2,
    )
    for suspicion in preview.suspicions:
        print_text(f"looks wrong: {suspicion}")
