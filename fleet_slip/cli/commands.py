"""All commands: which module has each, and what the list of commands says of it.

A module is imported when one of its commands is called. So `--help` and shell completion wait for
none of them, and a command waits for what it needs itself.
"""

from importlib import import_module
from typing import Any, Final, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_group

MARKUP: Final = "markdown"
"""What the help texts are written in."""


class Command(NamedTuple):
    """Where a command is, and the first paragraph of its help."""

    module: str
    summary: str


COMMANDS = {
    "run": Command(
        "run",
        "Do the whole job: simulate what is missing, gram, select, publish if it is not worse.",
    ),
    "simulate": Command("data", "Simulate what is missing of a campaign and write it to the logs."),
    "ingest": Command(
        "data",
        "Bring measured logs into the warehouse through a mapping of columns, units and axes.",
    ),
    "gram": Command(
        "data",
        "Reduce new log files to Gram rows, and drop the rows of files that are gone.",
    ),
    "check": Command("data", "Compute Gram rows three ways and compare them, bit for bit."),
    "select": Command(
        "selecting",
        "Compare models on a cohort by cross-validation and choose one. Reads Gram rows only.",
    ),
    "publish": Command(
        "publishing",
        "Select on a cohort and make the winner the next version of a model, and its champion.",
    ),
    "models": Command("models", "List the published model versions."),
    "show": Command(
        "models",
        "Show one model version: coefficients, figures, and the data that made it.",
    ),
    "promote": Command(
        "models",
        "Point an alias, the champion unless told otherwise, at a version.",
    ),
    "rollback": Command(
        "models",
        "Point an alias back at the version that it had before; no publication moves it from "
        "there.",
    ),
    "pin": Command(
        "models",
        "Keep an alias where it is: publications become candidates, until promote or unpin.",
    ),
    "unpin": Command("models", "Let publications move an alias again, after pin or rollback."),
    "diff": Command(
        "comparing",
        "Tell two model versions apart: their data, signals, coefficients and figures.",
    ),
    "score": Command(
        "evaluate",
        "Evaluate a model on the rows of a cohort: also the largest error and percentiles.",
    ),
    "diagnose": Command(
        "diagnosing",
        "Fit a model's signals to a cohort and examine the fit, from Gram rows.",
    ),
    "features": Command(
        "statistics",
        "List the features and feature sets of configs/features.toml.",
    ),
    "config": Command(
        "configs",
        "List the config files that are in force, and where each comes from.",
    ),
    "what-if": Command(
        "statistics",
        "Predict a model's error with worse sensors, in closed form; nothing is simulated.",
    ),
    "regimes": Command(
        "statistics",
        "Show a model's error by speed and lateral acceleration, and whether to split it there.",
    ),
    "shrink": Command(
        "statistics",
        "Compare least squares with ridge, lasso, James-Stein and Pace regression.",
    ),
    "evaluate": Command(
        "evaluate",
        "Evaluate models on the paper's test drives and on others; simulates those that are "
        "missing.",
    ),
    "report": Command(
        "report",
        "Write one page that lays our figures beside the paper's, from the latest evaluation.",
    ),
    "status": Command(
        "status",
        "Tell the warehouse's health: freshness, backlog, last runs, disk, champions.",
    ),
    "quality": Command(
        "operations",
        "Find stuck, saturated, biased, noisy, scaled, reversed and swapped sensors, drive by "
        "drive.",
    ),
    "monitor": Command(
        "operations",
        "Chart a model's error on each day since it was trained, with control limits.",
    ),
    "migrate": Command(
        "operations",
        "Bring the logs to the signal catalogue: add columns, convert counts to other scales.",
    ),
    "verify": Command(
        "maintenance",
        "Verify every byte against its checksum, and everything against everything else.",
    ),
    "compact": Command(
        "maintenance",
        "Turn the small log files of each day into large ones. Readers and jobs are not disturbed.",
    ),
    "vacuum": Command(
        "maintenance",
        "Remove replaced files and leftovers of killed jobs when they are old enough.",
    ),
    "forget": Command(
        "maintenance",
        "Forget a vehicle or a drive: in logs, Gram rows and quarantine; mark the models it "
        "trained.",
    ),
    "retain": Command(
        "maintenance",
        "Forget drives that are older than the retention says, then vacuum. For a schedule.",
    ),
    "keygen": Command(
        "signing",
        "Make a key to sign model versions with. Keep it where versions are made, and nowhere "
        "else.",
    ),
    "sign": Command("signing", "Sign a version that was published without a signature."),
    "sql": Command(
        "query",
        "Query the warehouse: log (SI), log_counts, drives, grams, models, quarantine, dictionary.",
    ),
    "shell": Command(
        "query",
        "Type SQL queries against the warehouse, one after the other. End with .quit or Ctrl-D.",
    ),
}


class CommandGroup(TyperGroup):
    """The commands, listed from their summaries; the one that is called is loaded."""

    def __init__(self, **settings: Any) -> None:
        """Add a command that has nothing but its summary for each of `COMMANDS`."""
        super().__init__(**settings)
        for name, (_, summary) in COMMANDS.items():
            self.add_command(
                TyperCommand(name, help=summary, rich_markup_mode=self.rich_markup_mode)
            )

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Put the command that is called in the place of its summary."""
        if args[0] in COMMANDS:
            self.commands.update(load_commands(COMMANDS[args[0]].module))
        return super().resolve_command(ctx, args)


def load_commands(module: str) -> dict[str, Any]:
    """Return the commands of one of the modules of `fleet_slip.cli`, by name."""
    app = typer.Typer(rich_markup_mode=MARKUP)
    import_module(f"fleet_slip.cli.{module}").register(app)
    return dict(get_group(app).commands)
