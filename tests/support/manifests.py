"""Manifests to publish, and publishing without a selection."""

from decimal import Decimal
from fractions import Fraction

from fleet_slip.models.manifest import (
    CrossValidated,
    Manifest,
    ModelLabel,
    ModelTerm,
    SelectedBy,
    TrainedOn,
    checksum_of_drives,
)
from fleet_slip.models.registry import CHAMPION, ModelVersion, Registry


def manifest(coefficient: Fraction = Fraction(1, 3), name: str = "sideslip") -> Manifest:
    return Manifest(
        name=name,
        label=ModelLabel(
            signal="sideslip", column="sideslip_rad", unit="rad", scale=Decimal("0.0001")
        ),
        intercept=0.0,
        intercept_exact=Fraction(0),
        terms=(
            ModelTerm(
                signal="ay",
                column="ay_mps2",
                unit="m/s^2",
                scale=Decimal("0.001"),
                coefficient=float(coefficient),
                coefficient_exact=coefficient,
            ),
        ),
        cross_validation=CrossValidated(
            folds_by="drive", folds=5, correlation=0.99, correlation_standard_error=0.001,
            rmse_deg=0.1, error_mean_deg=0.0, error_std_deg=0.1, condition_number=1.0,
        ),
        trained_on=TrainedOn(
            cohort="true", drives=3, vehicles=1, rows=300, logs_version=1, grams_version=1,
            drives_sha256=checksum_of_drives(b""),
        ),
        selected_by=SelectedBy(model_list="table1", model="1", reason="best", config_sha256="0"),
        package_version="0",
    )  # fmt: skip


def publish(registry: Registry, manifest: Manifest) -> ModelVersion:
    """Make a manifest the next version of its model, and its champion."""
    version = registry.add(manifest, b"")
    history = registry.history(manifest.name)
    number = version.version

    def move(newest: int) -> bool | None:
        is_current = history.pointed_at(CHAMPION) == number
        return is_current or history.move(CHAMPION, number, "publish", after=newest) or None

    history.decide(move)
    return version
