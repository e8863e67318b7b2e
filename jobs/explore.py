"""A data root to look at and to play with: `fleet-slip explore` opens it in the browser.

A marimo notebook (https://marimo.io). `marimo edit` shows and changes its code.
"""

import marimo

app = marimo.App(width="medium", app_title="fleet-slip explore")


@app.cell
def _():
    import altair as alt
    import marimo as mo
    import numpy as np
    import polars as pl
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure

    import fleet_slip
    from fleet_slip.base import pluralize
    from fleet_slip.errors import FleetSlipError
    from fleet_slip.evaluation.watch import drive_frames
    from fleet_slip.pages.page import colour

    return (
        Figure, FleetSlipError, LinearSegmentedColormap, alt, colour,
        drive_frames, fleet_slip, mo, np, pluralize, pl,
    )  # fmt: skip


@app.cell
def _(fleet_slip, mo, pluralize):
    fleet = fleet_slip.open(mo.cli_args().get("root"), mo.cli_args().get("config"))
    with fleet.session() as session:
        drives = session.sql("SELECT * FROM drives ORDER BY drive_id").pl()
        trained = session.sql("SELECT DISTINCT name FROM models ORDER BY 1").pl()["name"].to_list()
    summary = f"{pluralize(drives.height, 'drive')}, {pluralize(len(trained), 'model')}"
    mo.md(f"# Drives and models of {fleet.root}\n\n{summary}")
    return drives, fleet, trained


@app.cell
def _(drives, mo, pl):
    training = drives.filter(pl.col("source") != "scenario")
    numbers = [
        name
        for name, kind in drives.schema.items()
        if (kind.is_numeric() or kind.is_temporal()) and training[name].n_unique() > 1
    ]
    across = mo.ui.dropdown(numbers, value=numbers[0], label="across")
    up = mo.ui.dropdown(numbers, value=numbers[min(1, len(numbers) - 1)], label="up")
    mo.vstack([mo.md("## A cohort by mouse\n\nDraw a box around drives."), mo.hstack([across, up])])
    return across, training, up


@app.cell
def _(across, alt, mo, training, up):
    chart = mo.ui.altair_chart(
        alt.Chart(training)
        .mark_circle(size=70, opacity=0.6)
        .encode(
            x=alt.X(across.value, scale=alt.Scale(zero=False, padding=12)),
            y=alt.Y(up.value, scale=alt.Scale(zero=False, padding=12)),
            color="vehicle_model",
            tooltip=["drive_id", "vehicle_id", across.value, up.value],
        )
        .properties(height=280, width="container")
    )
    chart
    return (chart,)


@app.cell
def _(FleetSlipError, chart, fleet, mo, pluralize, pl, training):
    chosen = chart.value if len(chart.value) else training
    listed = ", ".join("'" + name.replace("'", "''") + "'" for name in chosen["drive_id"].unique())
    try:
        compared = fleet.cohort(f"drive_id IN ({listed})").select()
        results = pl.DataFrame(
            [
                {
                    "model": item.name,
                    "signals": " ".join(item.signals),
                    "correlation": round(item.pooled.correlation, 4),
                    "RMSE deg": round(item.pooled.rmse_deg, 4),
                }
                for item in compared.models
            ]
        )
        display = mo.vstack([mo.md(f"{compared.winner.reason}"), mo.ui.table(results)])
    except FleetSlipError as error:
        display = mo.callout(str(error), kind="warn")
    mo.vstack([mo.md(f"**{pluralize(chosen['drive_id'].n_unique(), 'drive')}**"), display])
    return


@app.cell
def _(mo, trained, training):
    name = mo.ui.dropdown(trained, value=trained[0] if trained else None, label="model")
    drive = mo.ui.dropdown(
        sorted(training["drive_id"].unique()), value=training["drive_id"][0], label="drive"
    )
    mo.vstack([mo.md("## Where it errs"), mo.hstack([name, drive])])
    return drive, name


@app.cell
def _(
    Figure, LinearSegmentedColormap, colour, drive, drive_frames, fleet, mo, name, np
):  # fmt: skip
    mo.stop(name.value is None, mo.md("No model yet: `fleet-slip publish`."))
    frames = drive_frames(fleet.warehouse, drive.value, fleet.models.get(name.value))
    error = frames.estimate_deg - frames.sideslip_deg
    # From far below to far above; the hundredth of points beyond the bound have the last colour.
    shades = LinearSegmentedColormap.from_list(
        "error",
        ["#08519c", "#3d85c6", "#9dbfe0", "#c9cdd2", "#f2b183", "#de7426", "#8c3500"],
    )
    bound = max(float(np.nanquantile(abs(error), 0.99)), 0.01)
    error_map = Figure(figsize=(9, 4.5), layout="constrained")
    _axes = error_map.subplots()
    _axes.plot(*frames.track, color=colour("grid"), linewidth=6, zorder=0)
    _seen = _axes.scatter(
        frames.x_m, frames.y_m, c=error, cmap=shades, vmin=-bound, vmax=bound, s=6
    )
    _axes.set_aspect("equal")
    _axes.axis("off")
    error_map.colorbar(_seen, label="estimate - truth, deg", shrink=0.7, extend="both")
    error_map
    return


@app.cell
def _(fleet, mo, name, pluralize, pl):
    mo.stop(name.value is None)
    versions = fleet.models.registry
    terms = pl.DataFrame(
        [
            {"version": number, "input": term.signal, "coefficient": term.coefficient}
            for number in versions.versions(name.value)
            for term in versions.load(name.value, number).manifest.terms
        ]
    )
    counted = pluralize(terms["version"].n_unique(), "version")
    mo.md(f"## Coefficients over {counted} of {name.value}")
    return (terms,)


@app.cell
def _(alt, mo, terms):
    mo.ui.altair_chart(
        alt.Chart(terms)
        .mark_line(point=True)
        .encode(
            x="version:O",
            y=alt.Y("coefficient", scale=alt.Scale(zero=False)),
            row=alt.Row("input", header=alt.Header(labelAngle=0, labelAlign="left")),
        )
        .properties(height=60, width=500)
        .resolve_scale(y="independent"),
        chart_selection=False,
        legend_selection=False,
    )
    return


@app.cell
def _(FleetSlipError, alt, fleet, mo, name, pl):
    mo.stop(name.value is None)
    days = [day for (day,) in fleet.sql("SELECT DISTINCT day FROM drives ORDER BY 1").fetchall()]
    try:
        _since = days[len(days) // 2] if len(days) > 8 else None
        _chart = fleet.maintenance.monitor(name.value, since=_since)
        drift = alt.vconcat()
        for _figure, _limits in (("mean", _chart.mean_limits), ("std", _chart.std_limits)):
            _points = pl.DataFrame(
                {
                    "day": [str(item.day) for item in _chart.days],
                    "error": [getattr(item, f"error_{_figure}_deg") for item in _chart.days],
                    "kind": [
                        "training"
                        if item.training
                        else "beyond"
                        if _figure in item.alarms
                        else "new"
                        for item in _chart.days
                    ],
                }
            )
            _ends = [end for end in (_limits.lower, _limits.upper) if end is not None]
            _y = alt.Y("error", title=f"{_figure}, deg", scale=alt.Scale(zero=False))
            drift &= alt.Chart(_points, height=120, width=500).mark_point(filled=True).encode(
                x="day:T", y=_y, color="kind"
            ) + alt.Chart(pl.DataFrame({"error": _ends})).mark_rule(strokeDash=[4, 4]).encode(y=_y)
    except FleetSlipError as error:
        drift = mo.callout(str(error), kind="warn")
    mo.vstack(
        [mo.md("## Drift\n\nThe error on each day, beside the limits of the first half."), drift]
    )
    return


if __name__ == "__main__":
    app.run()
