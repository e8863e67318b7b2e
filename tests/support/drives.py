"""Drives whose truth is known: built from kinematics, or from the simulated car."""

from dataclasses import replace
from datetime import date

import numpy as np

from fleet_slip.arrays import BoolArray, FloatArray
from fleet_slip.evaluation.ekf import loaded_axles
from fleet_slip.evaluation.evaluated_drives import STEP_S, DriveSignals, LabelledDrive
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.campaign import Batch, load_campaign
from fleet_slip.simulation.simulate import simulate_batch
from fleet_slip.vehicle.parameters import VehicleParameters
from tests.support.catalog import SIGNALS

GPS_EVERY = 10


def rolling_drive(
    car: VehicleParameters,
    vx_mps: FloatArray,
    vy_mps: FloatArray,
    yaw_rate_rad_s: FloatArray,
    steer_rad: FloatArray,
) -> DriveSignals:
    """Return what exact sensors read of a motion, with wheels that roll without slip."""

    def rate(values: FloatArray) -> FloatArray:
        return np.diff(values, prepend=values[:1]) / STEP_S

    radius, half_track = car.tyre.rolling_radius_m, car.body.track_front_m / 2
    front = vy_mps + car.body.front_axle_m * yaw_rate_rad_s
    cosine, sine = np.cos(steer_rad), np.sin(steer_rad)
    turn = half_track * yaw_rate_rad_s
    fix = np.where(np.arange(len(vx_mps)) % GPS_EVERY == 0, 0.0, np.nan)
    vx_before = np.concatenate([vx_mps[:1], vx_mps[:-1]])
    vy_before = np.concatenate([vy_mps[:1], vy_mps[:-1]])
    return DriveSignals(
        ax_mps2=rate(vx_mps) - yaw_rate_rad_s * vy_before,
        ay_mps2=rate(vy_mps) + yaw_rate_rad_s * vx_before,
        yaw_rate_rad_s=yaw_rate_rad_s,
        wheel_fl_rad_s=(cosine * (vx_mps - turn) + sine * front) / radius,
        wheel_fr_rad_s=(cosine * (vx_mps + turn) + sine * front) / radius,
        wheel_rl_rad_s=(vx_mps - car.body.track_rear_m / 2 * yaw_rate_rad_s) / radius,
        wheel_rr_rad_s=(vx_mps + car.body.track_rear_m / 2 * yaw_rate_rad_s) / radius,
        steer_fl_rad=steer_rad,
        steer_fr_rad=steer_rad,
        gps_vx_mps=vx_mps + fix,
        gps_vy_mps=vy_mps + fix,
        steering_wheel_rad=car.steering.ratio * steer_rad,
    )


def slalom(car: VehicleParameters, rows: int) -> tuple[DriveSignals, FloatArray]:
    """Return an exact drive through curves at changing speed, and its side-slip."""
    time_s = np.arange(rows) * STEP_S
    vx = 20.0 + 5.0 * np.sin(0.2 * time_s)
    vy = 0.5 * np.sin(0.5 * time_s)
    yaw_rate = 0.2 * np.sin(0.5 * time_s + 0.3)
    steer = 0.03 * np.sin(0.5 * time_s)
    return rolling_drive(car, vx, vy, yaw_rate, steer), np.arctan2(vy, vx)


def noisy(drive: DriveSignals, seed: int) -> DriveSignals:
    """Return the drive as sensors with the paper's initial noise and bias report it."""
    generator = np.random.default_rng(seed)

    def measured(values: FloatArray, bias: float, std: float) -> FloatArray:
        return values + bias + std * generator.standard_normal(len(values))

    return DriveSignals(
        ax_mps2=measured(drive.ax_mps2, 0.15, 0.1),
        ay_mps2=measured(drive.ay_mps2, 0.15, 0.1),
        yaw_rate_rad_s=measured(drive.yaw_rate_rad_s, 0.01, 0.01),
        wheel_fl_rad_s=measured(drive.wheel_fl_rad_s, 0, 0.02),
        wheel_fr_rad_s=measured(drive.wheel_fr_rad_s, 0, 0.02),
        wheel_rl_rad_s=measured(drive.wheel_rl_rad_s, 0, 0.02),
        wheel_rr_rad_s=measured(drive.wheel_rr_rad_s, 0, 0.02),
        steer_fl_rad=measured(drive.steer_fl_rad, 0, 0.0002),
        steer_fr_rad=measured(drive.steer_fr_rad, 0, 0.0002),
        gps_vx_mps=measured(drive.gps_vx_mps, 0, 0.05),
        gps_vy_mps=measured(drive.gps_vy_mps, 0, 0.05),
        steering_wheel_rad=measured(drive.steering_wheel_rad, 0, 0.003),
    )


def mirrored(drive: DriveSignals) -> DriveSignals:
    """Return the drive as seen in a mirror that swaps left and right."""
    return replace(
        drive,
        ay_mps2=-drive.ay_mps2,
        yaw_rate_rad_s=-drive.yaw_rate_rad_s,
        wheel_fl_rad_s=drive.wheel_fr_rad_s,
        wheel_fr_rad_s=drive.wheel_fl_rad_s,
        wheel_rl_rad_s=drive.wheel_rr_rad_s,
        wheel_rr_rad_s=drive.wheel_rl_rad_s,
        steer_fl_rad=-drive.steer_fr_rad,
        steer_fr_rad=-drive.steer_fl_rad,
        gps_vy_mps=-drive.gps_vy_mps,
        steering_wheel_rad=-drive.steering_wheel_rad,
    )


def simulated_drive() -> LabelledDrive:
    """Return half a lap at moderate speed in the D-class sedan, as the warehouse would have it."""
    spec = load_campaign("smoke", SHIPPED_CONFIGS).drives(date(2024, 5, 1))[0]
    table = simulate_batch(SIGNALS, Batch("smoke", date(2024, 5, 1), 0, (spec,)))
    columns = {
        signal.column: table[name].to_numpy().astype(float) * float(signal.scale)
        for name, signal in SIGNALS.signals.items()
        if name in table.column_names
    }
    names = DriveSignals.__dataclass_fields__
    signals = DriveSignals(**{name: columns[name] for name in names})
    return LabelledDrive("smoke", signals, columns["sideslip_rad"])


def without_fixes(drive: DriveSignals, lost: BoolArray) -> DriveSignals:
    """Return the drive without the GPS fixes where `lost` is true."""
    return replace(
        drive,
        gps_vx_mps=np.where(lost, np.nan, drive.gps_vx_mps),
        gps_vy_mps=np.where(lost, np.nan, drive.gps_vy_mps),
    )


def steady_sideslip_rad(car: VehicleParameters, vx_mps: float, yaw_rate_rad_s: float) -> float:
    """Return β of steady cornering, arctan(b r / vx − a m vx r / (Cr L))."""
    body, still = car.body, np.zeros(1)
    rear_n = loaded_axles(car, still, still, adhesion=1.0)[1, 0]
    slip = body.front_axle_m * body.mass_kg * vx_mps / (rear_n * body.wheelbase_m)
    return float(np.arctan(yaw_rate_rad_s * (body.rear_axle_m / vx_mps - slip)))


TUNNEL_S = 20.0


def tunnel(rows: int, begin_s: float) -> BoolArray:
    """Return where a drive with one tunnel of `TUNNEL_S` has no fix."""
    time_s = np.arange(rows) * STEP_S
    lost: BoolArray = (time_s >= begin_s) & (time_s < begin_s + TUNNEL_S)
    return lost
