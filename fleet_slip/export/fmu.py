"""A program as an FMU for co-simulation (FMI 2.0), with sources and a binary for Linux.

Inputs are the signals and the output is the angle, in SI units. One tick is 10 ms. Parameters are
the properties of the car, as whole numbers. Standard: https://fmi-standard.org.
"""

import subprocess
import zipfile
from collections.abc import Mapping
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from platform import machine
from shutil import which
from tempfile import TemporaryDirectory

from fleet_slip.errors import ConfigError
from fleet_slip.export.c import c_header, c_source
from fleet_slip.export.program import Program
from fleet_slip.export.templating import c_prefix, distinct, fill_in_version, read_source
from fleet_slip.models.registry import ModelVersion

COMPILER = "cc"
COMPILE_TIMEOUT_S = 120
FILE_TIME = (1980, 1, 1, 0, 0, 0)
"""Time of all files in the archive, so that an export is reproducible."""


def fmu(version: ModelVersion, program: Program, checks: str) -> bytes:
    """Return the archive; `checks` is the content of a resource.

    Raises `ConfigError` without a C compiler, or on a machine other than x86-64.
    """
    prefix = c_prefix(version)
    words = {
        "token": _token(version),
        "about": f"{version.reference}, SHA-256 {version.sha256}, trained on drives with SHA-256 "
        f"{version.manifest.trained_on.drives_sha256}",
        "parameters": _parameters(program),
        "units": _units(program),
        "valid": "true if there is an angle; otherwise the angle is 0",
    }

    def filled(file: str) -> str:
        return fill_in_version(f"fmu_sources/{file}", version, program, **words)

    sources = {
        f"{prefix}.h": c_header(version, program),
        f"{prefix}.c": c_source(version, program),
        "fmi_model.h": filled("fmi_model.h"),
        "fmi2.c": read_source("fmu_sources/fmi2.c"),
    }
    return _archive(
        {
            "modelDescription.xml": filled("modelDescription.xml"),
            **{f"sources/{name}": text for name, text in sources.items()},
            f"binaries/linux64/{prefix}.so": _compile(sources),
            "resources/checks.csv": checks,
        }
    )


def _archive(content: Mapping[str, str | bytes]) -> bytes:
    file = BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(zipfile.ZipInfo(name, FILE_TIME), data, zipfile.ZIP_DEFLATED)
    return file.getvalue()


def _compile(sources: Mapping[str, str]) -> bytes:
    """Compile the shared library for this machine."""
    if which(COMPILER) is None or machine() != "x86_64":
        raise ConfigError(
            "an FMU contains a binary for Linux on x86-64. Export it on such a machine with the C "
            f"compiler {COMPILER}. Run: apt-get install gcc libc6-dev"
        )
    with TemporaryDirectory() as folder:
        for name, text in sources.items():
            (Path(folder) / name).write_text(text, "utf-8")
        files = [name for name in sources if name.endswith(".c")]
        options = ["-std=c99", "-O2", "-shared", "-fPIC", "-fvisibility=hidden"]
        result = subprocess.run(  # noqa: S603 - fixed arguments
            [COMPILER, *options, *files, "-o", "library.so", "-lm"],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
            timeout=COMPILE_TIMEOUT_S,
        )
        if result.returncode:
            raise ConfigError(f"{COMPILER} cannot compile the FMU: {result.stderr[-500:]}")
        return (Path(folder) / "library.so").read_bytes()


def _token(version: ModelVersion) -> str:
    digits = version.sha256
    ends = (0, 8, 12, 16, 20, 32)
    return "{" + "-".join(digits[a:b] for a, b in pairwise(ends)) + "}"


def _parameters(program: Program) -> list[tuple[str, str]]:
    """Return the names and descriptions of the parameters."""
    descriptions = [
        "whole number" if fact.equals is None else f"1 if it is {fact.equals}, else 0"
        for fact in program.facts
    ] + [f"in counts of {number.grain:f} {number.unit}" for number in program.numbers]
    names = [fact.field for fact in program.facts] + [number.name for number in program.numbers]
    return [
        (name, f"{description}; -2147483648 if unknown")
        for name, description in zip(distinct(names), descriptions, strict=True)
    ]


def _units(program: Program) -> dict[str, str]:
    """Return all units, each as powers of SI base units."""
    units = {}
    for unit in (*(signal.unit for signal in program.signals), program.angle.unit):
        powers: dict[str, int] = {}
        for sign, factor in zip((1, -1), unit.split("/"), strict=False):
            name = factor.rstrip("^0123456789")
            powers[name] = sign * int(factor[len(name) :].strip("^") or 1)
        units[unit] = " ".join(f'{name}="{power}"' for name, power in powers.items() if name != "1")
    return units
