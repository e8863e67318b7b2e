"""FMUs, driven by the functions of FMI 2.0 in their binaries."""

import csv
import ctypes
import subprocess
import zipfile
from collections.abc import Sequence
from ctypes import byref, c_char_p, c_double, c_int, c_size_t, c_uint, c_void_p
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from fleet_slip.export.program import Program
from fleet_slip.export.stepping import Sample
from tests.export.cars import Car

TICK_S = 0.01


def unpack(content: bytes, folder: Path) -> tuple[Any, ElementTree.Element]:
    """The library in an FMU, and its description."""
    with zipfile.ZipFile(BytesIO(content)) as archive:
        archive.extractall(folder)
    (library,) = folder.glob("binaries/*/*.so")
    description = ElementTree.parse(folder / "modelDescription.xml")  # noqa: S314 - our own
    return ctypes.CDLL(str(library)), description.getroot()


LOGGER = ctypes.CFUNCTYPE(None, c_void_p, c_char_p, c_int, c_char_p, c_char_p)


class Functions(ctypes.Structure):
    """The callbacks of FMI 2.0, of which the logger alone is set."""

    _fields_ = (("logger", LOGGER), *((name, c_void_p) for name in ("a", "f", "s", "e")))


class Fmu:
    """An instance of an FMU, called by the functions of FMI 2.0."""

    def __init__(self, library: Any, description: ElementTree.Element) -> None:
        self.library = library
        self.component = c_void_p(self.instantiate(description.attrib["guid"].encode()))
        self.references = {
            variable.attrib["name"]: int(variable.attrib["valueReference"])
            for variable in description.iter("ScalarVariable")
        }

    def instantiate(self, token: bytes) -> Any:
        call = self.library.fmi2Instantiate
        call.restype = c_void_p
        self.messages: list[tuple[bytes, bytes]] = []
        self._logger = LOGGER(lambda _, name, *more: self.messages.append((name, more[2])))
        self._functions = Functions(self._logger)
        functions = byref(self._functions)
        return call(b"car", c_int(1), c_char_p(token), None, functions, c_int(0), c_int(0))

    def call(self, function: str, *arguments: Any) -> int:
        return int(getattr(self.library, f"fmi2{function}")(self.component, *arguments))

    def write(self, kind: str, names: Sequence[str], values: Sequence[Any], number: Any) -> None:
        references = (c_uint * len(names))(*(self.references[name] for name in names))
        array = (number * len(names))(*values)
        assert self.call(f"Set{kind}", references, c_size_t(len(names)), array) == 0

    def read(self, kind: str, name: str, number: Any) -> Any:
        value = number()
        reference = c_uint(self.references[name])
        assert self.call(f"Get{kind}", byref(reference), c_size_t(1), byref(value)) == 0
        return value.value

    def step(self, step_s: float = TICK_S) -> int:
        return self.call("DoStep", c_double(0.0), c_double(step_s), c_int(0))


def drive_fmu(
    instance: Fmu, program: Program, car: Car, samples: Sequence[Sample]
) -> list[int | None]:
    """Return the angles that an FMU gives, in counts."""
    counts = [*car.fact_counts(program), *car.number_counts(program)]
    names = [fact.field for fact in program.facts] + [number.name for number in program.numbers]
    assert instance.call("Reset") == 0
    parameters = [-(2**31) if n is None else n for n in counts]
    instance.write("Integer", names, parameters, c_int)
    assert instance.call("ExitInitializationMode") == 0
    columns = [signal.column for signal in program.signals]
    scale = float(program.angle.scale)
    angles: list[int | None] = []
    for sample in samples:
        values = [
            np.nan if count is None else count * float(signal.scale)
            for count, signal in zip(sample, program.signals, strict=True)
        ]
        instance.write("Real", columns, values, c_double)
        assert instance.step() == 0
        valid = instance.read("Boolean", "valid", c_int)
        angle = instance.read("Real", program.angle.column, c_double)
        assert valid or angle == 0
        angles.append(round(angle / scale) if valid else None)
    return angles


def run_fmpy(*words: str) -> str:
    """Run FMPy and return what it prints."""
    done = subprocess.run(
        ["fmpy", *words], capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def simulate_with_fmpy(
    file: Path, columns: Sequence[str], rows: Sequence[Sequence[float]], output: str
) -> list[float]:
    """Return an output of an FMU after each tick, simulated by FMPy; `rows` are its inputs."""
    inputs, outputs = file.with_suffix(".in.csv"), file.with_suffix(".out.csv")
    with inputs.open("w", newline="") as stream:
        table = csv.writer(stream)
        table.writerow(["time", *columns])
        for tick, row in enumerate(rows):
            table.writerow([repr(tick * TICK_S), *map(repr, row)])
    words = ["--input-file", str(inputs), "--output-file", str(outputs)]
    times = ["--output-interval", str(TICK_S), "--stop-time", str(len(rows) * TICK_S)]
    run_fmpy("simulate", str(file), *words, *times)
    with outputs.open() as stream:
        # The first is from before the first tick.
        return [float(row[output]) for row in list(csv.DictReader(stream))[1:]]
