"""The night as an Airflow DAG (3.x): copy this file into the DAGs folder, and set the variables.

A command that calls for attention (exit code 10) fails the task, so that Airflow alerts, and is not
given again; what another process or the network caused is, and ends where it would have ended.
"""

import os
import subprocess

import pendulum
from airflow.sdk import dag, task
from airflow.sdk.exceptions import AirflowException, AirflowFailException

PROGRAM = os.environ.get("FLEET_SLIP", "fleet-slip")
AGAIN = {6, 8, 11, 12}
"""Exit codes after which it is worth while to give the command again: storage, a conflict, a
cluster, not all done."""


def give(*words: str) -> str:
    """Give a command; return what it printed."""
    done = subprocess.run([PROGRAM, *words], capture_output=True, text=True, check=False)
    print(done.stdout, done.stderr)
    if done.returncode in AGAIN:
        raise AirflowException(f"{words[0]} ended with exit code {done.returncode}")
    if done.returncode:
        raise AirflowFailException(f"{words[0]} ended with exit code {done.returncode}")
    return done.stdout


@dag(
    schedule="30 4 * * *",
    start_date=pendulum.datetime(2026, 1, 1, tz="UTC"),
    catchup=False,
    max_active_runs=1,
    default_args={"retries": 3, "retry_delay": pendulum.duration(minutes=10)},
)
def fleet_slip_nightly() -> None:
    """Do the night, then tell the health."""

    @task
    def nightly() -> str:
        inbox, mapping = os.environ["FLEET_SLIP_INBOX"], os.environ["FLEET_SLIP_MAPPING"]
        return give("nightly", "--inbox", inbox, "--mapping", mapping, "--model", "fleet", "--json")

    @task
    def status() -> str:
        return give("status", "--max-age-hours", "26", "--json")

    nightly() >> status()


nights = fleet_slip_nightly()

if __name__ == "__main__":
    nights.test()
