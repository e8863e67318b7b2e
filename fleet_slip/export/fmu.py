"""A program as FMUs for co-simulation, FMI 2.0 and 3.0: sources, and a binary for Linux inside.

https://fmi-standard.org. Inputs are the signals and the output is the angle, in SI units; one tick
is 10 ms. Parameters are what the car knows of itself, as whole numbers.
"""

import subprocess
import zipfile
from collections.abc import Mapping
from importlib.resources import files
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from platform import machine
from shutil import which
from string import Template
from tempfile import TemporaryDirectory
from typing import Literal
from xml.sax.saxutils import quoteattr

from fleet_slip.catalogue.signals import SAMPLE_TIME_S
from fleet_slip.errors import ConfigError
from fleet_slip.export.c.c_names import c_prefix, different, field_names
from fleet_slip.export.c.c_source import c_header, c_source
from fleet_slip.export.program import Program
from fleet_slip.models.model_version import ModelVersion

FmiVersion = Literal[2, 3]

SOURCES = files("fleet_slip.export") / "fmu_sources"
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
    sources = {
        f"{prefix}.h": c_header(version, program),
        f"{prefix}.c": c_source(version, program),
        "fmi_model.h": _model_header(version, program),
        "fmi_instance.h": (SOURCES / "fmi_instance.h").read_text("utf-8"),
        f"fmi{fmi}.c": (SOURCES / f"fmi{fmi}.c").read_text("utf-8"),
    }
    content: dict[str, str | bytes] = {
        "modelDescription.xml": _description_2(version, program)
        if fmi == 2
        else _description_3(version, program),
        **{f"sources/{name}": text for name, text in sources.items()},
        f"{BINARIES[fmi]}/{prefix}.so": _compile(sources),
        "resources/checks.csv": checks,
    }
    if fmi == 3:
        content["sources/buildDescription.xml"] = _filled("buildDescription.xml", version)
        content["terminalsAndIcons/terminalsAndIcons.xml"] = _terminals(program)
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
            "an FMU has a binary for Linux on x86-64 inside: export it on such a machine, with a C "
            f"compiler called {COMPILER}, such as: apt-get install gcc libc6-dev"
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
            raise ConfigError(f"{COMPILER} cannot make the FMU's binary: {done.stderr[-500:]}")
        return (Path(folder) / "library.so").read_bytes()


def _model_header(version: ModelVersion, program: Program) -> str:
    """Return what tells the wrapper of the estimator."""
    prefix, fields = c_prefix(version), field_names(program)
    known = [*fields["facts"], *fields["numbers"]]
    scales = ", ".join(f"{one.scale:f}" for one in program.signals)
    fills = "\n".join(f"    to->{f} = counts[{i}];" for i, f in enumerate(fields["signals"]))
    if known:
        told = "\n".join(f"    car.{field} = told[{i}];" for i, field in enumerate(known))
        begins = f"    {prefix}_car car;\n{told}\n    {prefix}_start(state, &car);"
    else:
        begins = f"    (void)told;\n    {prefix}_start(state);"
    return _filled(
        "fmi_model.h",
        version,
        signals=len(program.signals),
        told=len(known),
        scale=f"{program.angle.scale:f}",
        scales=scales,
        fills=fills,
        begins=begins,
    )


def _filled(file: str, version: ModelVersion, **more: object) -> str:
    """Return a file of `fmu_sources` with what stands for its names."""
    known = {"prefix": c_prefix(version), "token": _token(version), "tick": float(SAMPLE_TIME_S)}
    return Template((SOURCES / file).read_text("utf-8")).substitute(known, **more)


def _token(version: ModelVersion) -> str:
    digits = version.sha256
    ends = (0, 8, 12, 16, 20, 32)
    return "{" + "-".join(digits[a:b] for a, b in pairwise(ends)) + "}"


def _about(version: ModelVersion) -> str:
    drives = version.manifest.trained_on.told_by or "unknown"
    return quoteattr(
        f"{version.reference}, SHA-256 {version.sha256}, trained on drives with SHA-256 {drives}"
    )


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


_VALID = "whether there is an angle; where there is none, the angle is 0"


def _units(program: Program) -> str:
    """Return the definitions of all units, in powers of the SI's base units."""
    found = []
    for unit in dict.fromkeys([*(one.unit for one in program.signals), program.angle.unit]):
        powers: dict[str, int] = {}
        for sign, part in zip((1, -1), unit.split("/"), strict=False):
            name = part.rstrip("^0123456789")
            powers[name] = sign * int(part[len(name) :].strip("^") or 1)
        base = " ".join(f'{name}="{power}"' for name, power in powers.items() if name != "1")
        found.append(f"    <Unit name={quoteattr(unit)}><BaseUnit {base}/></Unit>\n")
    return f"  <UnitDefinitions>\n{''.join(found)}  </UnitDefinitions>\n"


def _description_2(version: ModelVersion, program: Program) -> str:
    angle = program.angle
    given = 'causality="input" variability="discrete"'
    variables = [
        (one.column, "", given, f'<Real unit={quoteattr(one.unit)} start="0"/>')
        for one in program.signals
    ]
    variables += [
        (name, said, 'causality="parameter" variability="fixed"', '<Integer start="-2147483648"/>')
        for name, said in _told(program)
    ]
    made = 'causality="output" variability="discrete" initial="calculated"'
    variables += [
        (angle.column, "", made, f"<Real unit={quoteattr(angle.unit)}/>"),
        ("valid", _VALID, made, "<Boolean/>"),
    ]
    listed = "".join(
        f'    <ScalarVariable name={quoteattr(name)} valueReference="{place}" {kind} '
        f"description={quoteattr(said)}>{value}</ScalarVariable>\n"
        for place, (name, said, kind, value) in enumerate(variables)
    )
    unknowns = "".join(f'<Unknown index="{len(variables) - i}"/>' for i in (1, 0))
    return _filled(
        "modelDescription2.xml",
        version,
        about=_about(version),
        units=_units(program),
        variables=listed,
        unknowns=unknowns,
    )


def _description_3(version: ModelVersion, program: Program) -> str:
    angle = program.angle
    variables = [
        f'<Float64 name={quoteattr(one.column)} valueReference="{place}" causality="input" '
        f'variability="discrete" unit={quoteattr(one.unit)} start="0"/>'
        for place, one in enumerate(program.signals)
    ]
    for name, said in _told(program):
        variables.append(
            f'<Int32 name={quoteattr(name)} valueReference="{len(variables)}" '
            f'causality="parameter" variability="fixed" start="-2147483648" '
            f"description={quoteattr(said)}/>"
        )
    first, made = len(variables), 'causality="output" variability="discrete" initial="calculated"'
    variables += [
        f'<Float64 name={quoteattr(angle.column)} valueReference="{first}" {made} '
        f"unit={quoteattr(angle.unit)}/>",
        f'<Boolean name="valid" valueReference="{first + 1}" {made} '
        f"description={quoteattr(_VALID)}/>",
        f'<Float64 name="time" valueReference="{first + 2}" causality="independent" '
        'variability="continuous"/>',
    ]
    listed = "".join(f"    {one}\n" for one in variables)
    structure = "".join(
        f'    <{kind} valueReference="{place}"/>\n'
        for kind in ("Output", "InitialUnknown")
        for place in (first, first + 1)
    )
    return _filled(
        "modelDescription3.xml",
        version,
        about=_about(version),
        units=_units(program),
        variables=listed,
        unknowns=structure,
    )


def _terminals(program: Program) -> str:
    """Return a terminal with the inputs and one with the outputs, to connect at once."""
    ends = {
        "signals": [one.column for one in program.signals],
        "estimate": [program.angle.column, "valid"],
    }
    listed = "".join(
        f'    <Terminal name="{name}" matchingRule="bus">\n'
        + "".join(
            f"      <TerminalMemberVariable variableName={quoteattr(one)} "
            f'memberName={quoteattr(one)} variableKind="signal"/>\n'
            for one in members
        )
        + "    </Terminal>\n"
        for name, members in ends.items()
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<fmiTerminalsAndIcons fmiVersion="3.0">\n'
        f"  <Terminals>\n{listed}  </Terminals>\n</fmiTerminalsAndIcons>\n"
    )
