"""Estimators of side-slip that need a model: the paper's Kalman filter and model-based observers.

Each module has one estimator, and each estimator one form:

    estimate(drive: DriveSignals, car: VehicleParameters, parameters) -> sideslip_rad

`parameters` is the module's own pydantic model, with defaults. See docs/observers.md.
"""
