"""A program as a JSON document, from which an implementation can be written: docs/export.md.

Whole numbers that may need more than 53 bits are texts.
"""

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from fleet_slip.canonical import canonical_json, sha256_of
from fleet_slip.catalogue.definitions import LARGEST_FACT
from fleet_slip.catalogue.signals import SAMPLE_TIME_S
from fleet_slip.columns.lowering import CarFact
from fleet_slip.export.checks import Check
from fleet_slip.export.costs import count_costs
from fleet_slip.export.program import Angle, Input, Program
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.models.trained_drives import checksum_of_drives

FORMAT = "fleet-slip estimator"
SCHEMA = 2
"""Number of the schema: it changes if an implementation of before would compute something else."""


def document_of(
    version: ModelVersion, program: Program, checks: Sequence[Check], drives: bytes | None
) -> dict[str, Any]:
    """Return the document of a published version; `sha256` is of everything else in it.

    `drives` is the content of the file about the drives that trained it.
    """
    told_by = version.manifest.trained_on.drives_sha256
    if drives is not None:
        told_by = checksum_of_drives(drives)
    content: dict[str, Any] = {
        "format": FORMAT,
        "schema": SCHEMA,
        "model": {
            "reference": version.reference,
            "sha256": version.sha256,
            "drives_sha256": told_by,
            "drives": None if drives is None else base64.b64encode(drives).decode("ascii"),
            "manifest": version.manifest.model_dump(mode="json"),
        },
        "program": program_content(program),
        "costs": count_costs(program).as_dict(),
        "checks": [asdict(one) for one in checks],
    }
    return {**content, "sha256": sha256_of(canonical_json(content))}


def program_content(program: Program) -> dict[str, Any]:
    """Return the program alone."""
    return {
        "tick_s": str(float(SAMPLE_TIME_S)),
        "signals": [_signal(one) for one in program.signals],
        "facts": [_fact(one) for one in program.facts],
        "numbers": [
            {"name": one.name, "unit": one.unit, "grain": f"{one.grain:f}"}
            for one in program.numbers
        ],
        "steps": [list(step) for step in program.steps],
        "angle": _angle(program.angle),
    }


def _signal(one: Input) -> dict[str, Any]:
    return {
        "name": one.name,
        "column": one.column,
        "unit": one.unit,
        "scale": f"{one.scale:f}",
        "min": one.min_count,
        "max": one.max_count,
    }


def _fact(one: CarFact) -> dict[str, Any]:
    if one.equals is not None:
        return {"name": one.name, "equals": one.equals}
    return {"name": one.name, "largest": LARGEST_FACT}


def _angle(angle: Angle) -> dict[str, Any]:
    return {
        "name": angle.name,
        "column": angle.column,
        "unit": angle.unit,
        "scale": f"{angle.scale:f}",
        "bits": angle.bits,
        "intercept": str(angle.intercept),
        "terms": [
            {"step": step, "coefficient": str(coefficient)} for step, coefficient in angle.terms
        ],
        "error": f"{angle.error.numerator}/{angle.error.denominator}",
        "largest": angle.largest,
        "limit": angle.limit,
    }


def manifest_of(
    version: ModelVersion, program: Program, to: str, files: Mapping[str, bytes]
) -> dict[str, Any]:
    """Return what is said of the files of an export: of which version, the error and the costs."""
    angle = program.angle
    return {
        "format": "fleet-slip export",
        "to": to,
        "model": version.reference,
        "sha256": version.sha256,
        "drives_sha256": version.manifest.trained_on.drives_sha256,
        "angle": {
            "column": angle.column,
            "unit": angle.unit,
            "scale": f"{angle.scale:f}",
            "error": f"{angle.error.numerator}/{angle.error.denominator}",
        },
        "costs": count_costs(program).as_dict(),
        "files": {name: hashlib.sha256(content).hexdigest() for name, content in files.items()},
    }
