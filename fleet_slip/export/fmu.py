"""A program as FMUs for co-simulation, FMI 2.0 and 3.0: sources, and a binary for Linux inside.

https://fmi-standard.org. Inputs are the signals and the output is the angle, in SI units; one tick
is 10 ms. Parameters are what the car knows of itself, as whole numbers.
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
from typing import Literal

from fleet_slip.errors import ConfigError
from fleet_slip.export.c import c_header, c_source
from fleet_slip.export.program import Program
from fleet_slip.export.templating import c_prefix, different, fill_in_version, read_source
from fleet_slip.models.registry import ModelVersion

FmiVersion = Literal[2, 3]

COMPILER = "cc"
LONGEST_COMPILATION_S = 120
BINARIES = {2: "binaries/linux64", 3: "binaries/x86_64-linux"}
FIRST_MOMENT = (1980, 1, 1, 0, 0, 0)
"""Of all files in the archive, so that an export is the same again."""


def fmu(version: ModelVersion, program: Program, checks: str, fmi: FmiVersion) -> bytes:
    """Return the archive; `checks` is a table that comes along.

    Raises `ConfigError` without a C compiler, or on a machine that is no x86-64.
    """
    prefix = c_prefix(version)
    words = {
        "token": _token(version),
        "about": f"{version.reference}, SHA-256 {version.sha256}, trained on drives with SHA-256 "
        f"{version.manifest.trained_on.drives_sha256}",
        "told": _told(program),
        "units": _units(program),
        "valid": "whether there is an angle; where there is none, the angle is 0",
    }

    def filled(file: str) -> str:
        return fill_in_version(f"fmu_sources/{file}", version, program, **words)

    sources = {
        f"{prefix}.h": c_header(version, program),
        f"{prefix}.c": c_source(version, program),
        "fmi_model.h": filled("fmi_model.h"),
        "fmi_instance.h": read_source("fmu_sources/fmi_instance.h"),
        f"fmi{fmi}.c": read_source(f"fmu_sources/fmi{fmi}.c"),
    }
    content: dict[str, str | bytes] = {
        "modelDescription.xml": filled(f"modelDescription{fmi}.xml"),
        **{f"sources/{name}": text for name, text in sources.items()},
        f"{BINARIES[fmi]}/{prefix}.so": _compile(sources),
        "resources/checks.csv": checks,
    }
    if fmi == 3:
        content["sources/buildDescription.xml"] = filled("buildDescription.xml")
        content["terminalsAndIcons/terminalsAndIcons.xml"] = filled("terminalsAndIcons.xml")
    return _archive(content)


def _archive(content: Mapping[str, str | bytes]) -> bytes:
    file = BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, one in content.items():
            archive.writestr(zipfile.ZipInfo(name, FIRST_MOMENT), one, zipfile.ZIP_DEFLATED)
    return file.getvalue()


def _compile(sources: Mapping[str, str]) -> bytes:
    """Return the shared library for this machine."""
    if which(COMPILER) is None or machine() != "x86_64":
        raise ConfigError(
            "an FMU contains a binary for Linux on x86-64: export it on such a machine, with the C "
            f"compiler {COMPILER}: apt-get install gcc libc6-dev"
        )
    with TemporaryDirectory() as folder:
        for name, text in sources.items():
            (Path(folder) / name).write_text(text, "utf-8")
        units = [name for name in sources if name.endswith(".c")]
        options = ["-std=c99", "-O2", "-shared", "-fPIC", "-fvisibility=hidden"]
        words = [COMPILER, *options, *units, "-o", "library.so", "-lm"]
        done = subprocess.run(  # noqa: S603 - our own words
            words,
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
            timeout=LONGEST_COMPILATION_S,
        )
        if done.returncode:
            raise ConfigError(f"{COMPILER} cannot compile the FMU: {done.stderr[-500:]}")
        return (Path(folder) / "library.so").read_bytes()


def _token(version: ModelVersion) -> str:
    digits = version.sha256
    ends = (0, 8, 12, 16, 20, 32)
    return "{" + "-".join(digits[a:b] for a, b in pairwise(ends)) + "}"


def _told(program: Program) -> list[tuple[str, str]]:
    """Return names and descriptions of the parameters."""
    said = [
        "whole number" if one.equals is None else f"1 if it is {one.equals}, else 0"
        for one in program.facts
    ] + [f"in counts of {one.grain:f} {one.unit}" for one in program.numbers]
    names = [one.field for one in program.facts] + [one.name for one in program.numbers]
    return [
        (name, f"{text}; -2147483648 where it is not known")
        for name, text in zip(different(names), said, strict=True)
    ]


def _units(program: Program) -> dict[str, str]:
    """Return all units, each in powers of the SI's base units."""
    found = {}
    for unit in (*(one.unit for one in program.signals), program.angle.unit):
        powers: dict[str, int] = {}
        for sign, part in zip((1, -1), unit.split("/"), strict=False):
            name = part.rstrip("^0123456789")
            powers[name] = sign * int(part[len(name) :].strip("^") or 1)
        found[unit] = " ".join(f'{name}="{power}"' for name, power in powers.items() if name != "1")
    return found
