"""Draws the signals of a drafted mapping, one panel each, before anything is stored."""

import numpy as np
from matplotlib.figure import Figure

from fleet_slip.arrays import FloatArray
from fleet_slip.base import quote_name
from fleet_slip.catalog.signals import SignalCatalog
from fleet_slip.ingest.columns import SignalColumn
from fleet_slip.ingest.draft import Draft
from fleet_slip.ingest.guess import Guess
from fleet_slip.pages.page import WIDTH_IN, Picture, colour, draw, fill_in

_PANEL_IN = 1.1


def write_signal_page(catalog: SignalCatalog, draft: Draft) -> str:
    """Return a page with the signals of a draft: in SI units, or as logged without a unit."""
    guesses = draft.guesses
    titles = []
    for name, guess in guesses.items():
        state = " (doubtful)" if guess.is_doubtful else ""
        unit = "no unit in the file" if guess.readings else catalog[name].unit
        titles.append(f"{name}{state} of {guess.column}, {unit}")
    picture = Picture(
        "signals",
        f"Signals of {quote_name(draft.file)}",
        "Check signs (left turn: ay, yaw rate and steering are positive), units and gaps.",
        f"Curves over time: {', '.join(guesses)}.",
        lambda: _panels(catalog, draft, list(guesses.items()), titles),
    )
    return fill_in("signals.html.j2", title=picture.title, figure=draw(picture))


def _panels(
    catalog: SignalCatalog, draft: Draft, guesses: list[tuple[str, Guess]], titles: list[str]
) -> Figure:
    """Draw one panel for each signal over time in s; Matplotlib leaves out invisible points."""
    figure = Figure(figsize=(WIDTH_IN, _PANEL_IN * len(guesses) + 0.5), layout="constrained")
    axes = figure.subplots(len(guesses), 1, sharex=True, squeeze=False)[:, 0]
    for panel, (name, guess), title in zip(axes, guesses, titles, strict=True):
        rate_hz = guess.profile.rate_hz or draft.time.rate_hz or 1.0
        values = in_si(catalog, name, guess)
        panel.plot(np.arange(values.size) / rate_hz, values, color=colour("model_4"), linewidth=0.8)
        panel.set_title(title)
    axes[-1].set_xlabel("time in s")
    return figure


def in_si(catalog: SignalCatalog, name: str, guess: Guess) -> FloatArray:
    """Return the values of a guess in the catalog's unit; as logged if the unit is open."""
    values = guess.profile.values
    if guess.readings or "north" in guess.keys:
        return values
    column = SignalColumn.model_validate(guess.entry)
    gain, bias = column.linear(catalog[name].unit)
    return np.asarray(gain * values + bias, dtype=np.float64)
