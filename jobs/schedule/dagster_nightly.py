"""Run the night as a Dagster asset with a schedule: `dagster dev -f dagster_nightly.py`.

A command that calls for attention (exit code 10) fails the run and is not given again; what another
process or the network caused is, and ends where it would have ended.
"""

import json
import os
import subprocess

import dagster

PROGRAM = os.environ.get("FLEET_SLIP", "fleet-slip")
AGAIN = {6, 8, 11, 12}
"""Exit codes after which it is worth while to give the command again: storage, a conflict, a
cluster, not all done."""


class Night(dagster.Config):
    """The inbox of logs, their mapping, and the model."""

    inbox: str = "/srv/fleet-slip/inbox"
    mapping: str = "/etc/fleet-slip/mapping.toml"
    model: str = "fleet"


@dagster.asset
def champion(context: dagster.AssetExecutionContext, config: Night) -> dagster.MaterializeResult:
    """Return the model version in use after the night."""
    words = ["--inbox", config.inbox, "--mapping", config.mapping, "--model", config.model]
    done = subprocess.run(
        [PROGRAM, "nightly", *words, "--json"], capture_output=True, text=True, check=False
    )
    context.log.info(done.stderr)
    if done.returncode:
        raise dagster.Failure(
            f"nightly ended with exit code {done.returncode}",
            allow_retries=done.returncode in AGAIN,
        )
    document = json.loads(done.stdout)
    figures = ("champion", "drives", "new_drives", "rows", "verdict")
    return dagster.MaterializeResult(metadata={name: document[name] for name in figures})


night = dagster.define_asset_job(
    "night", [champion], op_retry_policy=dagster.RetryPolicy(max_retries=3, delay=600)
)
definitions = dagster.Definitions(
    assets=[champion],
    jobs=[night],
    schedules=[dagster.ScheduleDefinition(job=night, cron_schedule="30 4 * * *")],
)
