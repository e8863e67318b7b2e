"""What is to be seen of a test drive, which is simulated if it is missing."""

from concurrent.futures import Executor

from fleet_slip.comparison.evaluation.evaluated_drives import load_drives
from fleet_slip.comparison.evaluation.scenario_runs import simulate_scenarios
from fleet_slip.comparison.watch.drive_frames import DriveFrames, frames_of
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.simulation.scenario import load_scenario
from fleet_slip.warehouse.tables import Warehouse


def scenario_frames(
    warehouse: Warehouse, name: str, version: ModelVersion, executor: Executor
) -> DriveFrames:
    """Return the frames of a test drive, simulated if missing. Raises `ConfigError`."""
    scenario = load_scenario(name)
    simulate_scenarios(warehouse, [scenario], executor)
    (drive,) = load_drives(warehouse, [scenario])
    columns = {
        **drive.signals,
        "sideslip_rad": drive.sideslip_rad,
        "vx_mps": drive.vx_mps,
        "vy_mps": drive.vy_mps,
        "station_m": drive.station_m,
        "lateral_offset_m": drive.lateral_offset_m,
    }
    facts = {**drive.facts, "track": scenario.track.name, "drive_id": scenario.drive_id}
    title = f"{scenario.name}: {scenario.description}"
    return frames_of(title, columns, facts, drive.time_s, version)
