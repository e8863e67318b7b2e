"""What `fleet-slip monitor` says of days like those before, and of days on which something changed.

    python -m benchmarks.drift [DAYS] [--drives 24]

Simulates DAYS days (12) of the campaign `fleet` with so many drives each, publishes a model, and
then lands six more days three times over: as before, on worn tyres, and on wet roads. Draws each
chart to drift_0.svg, drift_1.svg, drift_2.svg in the working directory.
"""

import argparse
import shutil
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from typing import Any

from fleet_slip.files.local_folder import LocalFolder
from fleet_slip.grams.rows.gram_job import update_grams
from fleet_slip.models.describe_winner import manifest_of
from fleet_slip.models.publish import publish
from fleet_slip.models.versions import Registry
from fleet_slip.monitoring.control_chart import save_chart
from fleet_slip.monitoring.monitor import Chart, monitor
from fleet_slip.selection.answer_request import answer_request
from fleet_slip.selection.request import SelectionRequest
from fleet_slip.simulation.campaign import Campaign, load_campaign
from fleet_slip.simulation.simulation_job import simulate_campaign
from fleet_slip.warehouse.tables import Warehouse

NEW_DAYS = 6
COHORT = "source = 'simulated'"


def base(days: int, drives: int) -> Campaign:
    update = {"drives_per_day": drives, "number_of_days": days}
    return load_campaign("fleet").model_copy(update=update)


def later(name: str, first: Campaign, update: Mapping[str, Any]) -> Campaign:
    """Return a campaign of the days after another one's, changed in some way."""
    content = first.model_dump()
    content |= {
        "name": f"fleet_{name}",
        "seed": first.seed + 1,
        "first_day": first.first_day + timedelta(days=first.number_of_days),
        "number_of_days": NEW_DAYS,
    }
    content["plan"] |= update.get("plan", {})
    content["sensors"] |= update.get("sensors", {})
    return first.model_copy(
        update={
            **{key: content[key] for key in ("name", "seed", "first_day", "number_of_days")},
            "plan": type(first.plan).model_validate(content["plan"]),
            "sensors": type(first.sensors).model_validate(content["sensors"]),
        }
    )


CHANGES: Mapping[str, Mapping[str, Any]] = {
    "as before": {},
    "worn tyres (stiffness 0.60-0.80 instead of 0.85-1.15)": {
        "plan": {"tyre_stiffness": {"min": 0.60, "max": 0.80}}
    },
    "wet roads (adhesion 0.4-0.6 instead of 0.6-1.0)": {
        "plan": {"adhesion": {"min": 0.4, "max": 0.6}}
    },
}


def land(warehouse: Warehouse, campaign: Campaign) -> None:
    with ThreadPoolExecutor(2) as executor:
        simulate_campaign(warehouse, campaign, campaign.days(), executor)
    update_grams(warehouse)


def train(warehouse: Warehouse) -> None:
    planned = answer_request(warehouse, SelectionRequest(), COHORT)
    manifest = manifest_of(planned, "sideslip")
    publish(Registry(warehouse.root / "models"), manifest, planned)


def tell(name: str, chart: Chart) -> None:
    mean, std = chart.mean_limits, chart.std_limits
    print(f"\n{name}: mean {mean.lower:+.4f} to {mean.upper:+.4f}, std up to {std.upper:.4f} deg")
    for day in chart.days:
        told = "training" if day.training else " ".join(f"ALARM {figure}" for figure in day.alarms)
        print(f"{day.day}  {day.error_mean_deg:+.4f}  {day.error_std_deg:.4f}  {told}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("days", type=int, nargs="?", default=12)
    parser.add_argument("--drives", type=int, default=24, help="of a day")
    given = parser.parse_args()
    first = base(given.days, given.drives)
    with tempfile.TemporaryDirectory() as folder:
        trained = Path(folder) / "trained"
        land(Warehouse(LocalFolder(trained)), first)
        train(Warehouse(LocalFolder(trained)))
        for number, (name, update) in enumerate(CHANGES.items()):
            root = Path(folder) / str(number)
            shutil.copytree(trained, root)
            warehouse = Warehouse(LocalFolder(root))
            land(warehouse, later(f"later_{number}", first, update))
            version = Registry(LocalFolder(root / "models")).resolve("sideslip")
            chart = monitor(warehouse, version, COHORT)
            tell(name, chart)
            save_chart(chart, Path(f"drift_{number}.svg"))


if __name__ == "__main__":
    main()
