"""All commands: which module has each. A module is imported when one of its commands is called.

So `--help` and shell completion wait for none of them, and a command waits for what it needs
itself. What the list of commands says of one is its docstring's, which Python finds in the module's
compiled code without running it. Help is plain text: boxes and colours took longer than all else.
"""

import inspect
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from importlib.abc import InspectLoader
from importlib.util import find_spec
from types import CodeType, FunctionType
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_group

GROUPS = {
    "Begin with": {
        "run": "begin.run_command",
        "sql": "begin.sql_command",
        "select": "begin.select_command",
        "publish": "begin.publish_command",
        "show": "models.version_commands",
    },
    "Data": {
        "simulate": "data.log_commands",
        "mapping": "data.mapping_command",
        "ingest": "data.log_commands",
        "gram": "data.gram_commands",
        "check": "data.gram_commands",
        "features": "data.features_command",
        "init": "data.init_command",
    },
    "Models": {
        "models": "models.version_commands",
        "diff": "models.diff_command",
        "promote": "models.version_commands",
        "rollback": "models.version_commands",
        "pin": "models.version_commands",
        "unpin": "models.version_commands",
        "export": "models.export_command",
    },
    "Accuracy": {
        "score": "accuracy.evaluate_commands",
        "evaluate": "accuracy.evaluate_commands",
        "identify": "accuracy.identify_command",
        "report": "accuracy.picture_commands",
        "watch": "accuracy.picture_commands",
        "explore": "accuracy.picture_commands",
        "diagnose": "accuracy.diagnose_command",
        "regimes": "accuracy.regimes_command",
        "what-if": "accuracy.what_if_command",
    },
    "Operations": {
        "nightly": "operations.nightly_command",
        "status": "operations.status_commands",
        "quality": "operations.quality_command",
        "calibrate": "operations.calibrate_command",
        "monitor": "operations.monitor_command",
        "verify": "operations.maintenance_commands",
        "compact": "operations.maintenance_commands",
        "vacuum": "operations.maintenance_commands",
        "forget": "operations.maintenance_commands",
        "retain": "operations.maintenance_commands",
        "migrate": "operations.migrate_command",
    },
}
"""The commands in the groups and the order of `--help`, and the module of `fleet_slip.cli` that has
each as a function."""

COMMANDS = {name: module for group in GROUPS.values() for name, module in group.items()}


class Command(TyperCommand):
    """A command whose help is plain text."""

    def get_help(self, ctx: Any) -> str:
        """Return the help without what marks examples in docstrings."""
        return super().get_help(ctx).replace("**", "")


class CommandGroup(TyperGroup):
    """The commands, listed from their docstrings; the one that is called is loaded."""

    def __init__(self, **settings: Any) -> None:
        """Add a command that has nothing but its docstring for each of `COMMANDS`."""
        super().__init__(**settings)
        for name, module in COMMANDS.items():
            self.add_command(Command(name, help=docstrings(module)[_function(name)]))

    def get_help(self, ctx: Any) -> str:
        """Return the help without what marks examples in docstrings."""
        return super().get_help(ctx).replace("**", "")

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002 - of the base
        """Write the commands, group by group."""
        wide = max(map(len, COMMANDS))
        left = formatter.width - wide - 6
        for group, names in GROUPS.items():
            with formatter.section(group):
                rows = [(name, self.commands[name].get_short_help_str(2 * left)) for name in names]
                formatter.write_dl([(f"{name:<{wide}}", text) for name, text in rows])

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Put the command that is called in the place of its docstring."""
        if args[0] in COMMANDS:
            self.commands[args[0]] = load_command(args[0])
        return super().resolve_command(ctx, args)


def load_command(name: str) -> Any:
    """Return a command, with its options."""
    module = import_module(f"fleet_slip.cli.{COMMANDS[name]}")
    app = typer.Typer(rich_markup_mode=None)
    app.command(name, cls=Command)(getattr(module, _function(name)))
    return get_group(app).commands[name]


@cache
def docstrings(module: str) -> Mapping[str, str]:
    """Return the docstrings of a module's functions by name; the module is not imported."""
    name = f"fleet_slip.cli.{module}"
    spec = find_spec(name)
    loader = spec.loader if spec else None
    compiled = loader.get_code(name) if isinstance(loader, InspectLoader) else None
    codes = [one for one in compiled.co_consts if isinstance(one, CodeType)] if compiled else []
    return {
        code.co_name: inspect.cleandoc(FunctionType(code, {}).__doc__ or "")
        for code in codes
        if not code.co_freevars
    }


def _function(command: str) -> str:
    return command.replace("-", "_")
