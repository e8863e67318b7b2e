"""The imperfections that `benchmarks.realism` tries: each group alone, and all at once."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from fleet_slip.simulation.campaign import DriveSpec, load_campaign
from fleet_slip.simulation.drive_plan import FleetPlan
from fleet_slip.simulation.imperfections import NONE, WORN_RADIUS, WORN_STIFFNESS, Imperfections
from fleet_slip.simulation.scenario import load_scenario

GROUPS: dict[str, tuple[str, ...]] = {
    "none": (),
    "play of the steering": ("steering_lash_deg",),
    "compliance of the steering": ("steering_compliance_deg_per_kn",),
    "straight-ahead offset": ("steering_offset_deg",),
    "front wheel angles' own errors": (
        "wheel_angle_offset_fl_deg",
        "wheel_angle_offset_fr_deg",
        "wheel_angle_scale_error",
    ),
    "toe and thrust angle": ("toe_front_deg", "toe_rear_deg", "thrust_angle_deg"),
    "four radii": (
        "radius_error_fl",
        "radius_error_fr",
        "radius_error_rl",
        "radius_error_rr",
    ),
    "... rear left alone, +0.3 %": ("radius_error_rl",),
    "radius over load": ("radius_loss_mm_per_kn",),
    "wheel pulses": ("wheel_pulses_per_turn", "wheel_pitch_error"),
    "200 kg on the rear seats": ("load",),
    "worn tyres": ("wear",),
    "relaxation length": ("relaxation_length_m",),
    "cold tyres": ("cold_stiffness",),
    "roll and pitch": ("roll_gradient_deg_per_g", "pitch_gradient_deg_per_g"),
    "inertial unit off the centre": ("inertial_x_m", "inertial_y_m"),
    "inertial unit turned": ("inertial_roll_deg", "inertial_pitch_deg", "inertial_yaw_deg"),
    "bandwidth and latency of sensors": (
        "inertial_bandwidth_hz",
        "inertial_latency_s",
        "steering_latency_s",
        "wheel_latency_s",
    ),
    "bandwidth and latency of the label": ("label_bandwidth_hz", "label_latency_s"),
    "label turned": ("label_offset_deg",),
    "bank": ("cross_slope_percent", "superelevation_percent", "bank_std_percent"),
    "grade": ("grade_std_percent",),
    "adhesion along and across": ("adhesion_std", "adhesion_split_std"),
    "wind": ("wind_mps", "gust_std_mps", "side_force_area_m2", "yawing_moment_volume_m3"),
    "GPS: heading": ("gps_heading_std_deg", "gps_correlation_s"),
    "GPS: latency and lasting errors": (
        "gps_latency_s",
        "gps_velocity_std_mps",
        "gps_correlation_s",
    ),
}
"""Fields of `Imperfections` that belong together; `load` stands for that of the scenario, `wear`
for tyres without tread, as after the life of a set."""


ROUGH_GROUPS: dict[str, tuple[str, ...]] = {
    "none": (),
    "aligning torque": ("aligning_compliance_deg_per_knm",),
    "roll of the body alone": ("roll_gradient_deg_per_g",),
    "... and camber by roll": ("roll_gradient_deg_per_g", "camber_per_roll"),
    "biases that drift": ("acceleration_drift_mps2", "yaw_rate_drift_rad_s", "drift_s"),
    "lever of the label": ("label_x_m",),
    "noise of the label by 1 / v": ("label_velocity_std_mps",),
    "clock jitter": ("clock_jitter_s",),
    "inertial and steering at 50 Hz": ("inertial_held_ticks", "steering_held_ticks"),
    "wheels at 33 Hz": ("wheel_held_ticks",),
    "road of class B": ("roughness_cm3",),
}
"""What `fleet_rough` adds."""


@dataclass(frozen=True)
class Case:
    """One group of imperfections, in all drives alike."""

    name: str
    flaws: Imperfections
    loaded: bool
    worn: bool

    def spec(self, drive: DriveSpec) -> DriveSpec:
        """Return a drive with the imperfections."""
        scenario = load_scenario("imperfect")
        assert scenario.sprung_mass_kg is not None
        vehicle = drive.vehicle
        if self.loaded:
            vehicle = vehicle.with_sprung_mass(scenario.sprung_mass_kg, scenario.load_position_m)
        if self.worn:
            vehicle = vehicle.with_tyres(
                stiffness_factor=WORN_STIFFNESS, rolling_radius_factor=WORN_RADIUS
            )
        return replace(drive, flaws=self.flaws, vehicle=vehicle)


def rough() -> Imperfections:
    """Return the scenario's figures, with the middle of the ranges that `fleet_rough` adds.

    Of a range about zero it is the end.
    """
    figures = load_scenario("imperfect").imperfections.model_dump()
    plan = load_campaign("fleet_rough").plan
    assert isinstance(plan, FleetPlan) and plan.imperfections
    added = {name for names in ROUGH_GROUPS.values() for name in names}
    for kind, ranges in (
        ("car", plan.imperfections.car),
        ("sensors", plan.imperfections.sensors),
        ("road", plan.imperfections.road),
    ):
        for name, bounds in ranges.items():
            if name in added and name not in figures[kind]:
                middle = bounds.max if bounds.min < 0 else (bounds.min + bounds.max) / 2
                figures[kind][name] = math.ceil(middle) if name.endswith("_ticks") else middle
    return Imperfections.model_validate(figures)


def cases(of_rough: bool = False) -> list[Case]:
    """Return each group alone, and all at once."""
    whole = rough() if of_rough else load_scenario("imperfect").imperfections
    found = [
        Case(name, part_of(whole, names), "load" in names, "wear" in names)
        for name, names in (ROUGH_GROUPS if of_rough else GROUPS).items()
    ]
    return [*found, Case("everything", whole, loaded=True, worn=True)]


def part_of(whole: Imperfections, names: Sequence[str]) -> Imperfections:
    """Return the named figures of the whole, all others zero."""
    part = NONE.model_dump()
    for kind, figures in whole.model_dump().items():
        part[kind] |= {name: value for name, value in figures.items() if name in names}
    return Imperfections.model_validate(part)
