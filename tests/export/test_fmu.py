"""Exported FMUs: driven through their binaries here, and by FMPy where it is installed."""

import csv
import ctypes
import subprocess
import zipfile
from collections.abc import Sequence
from ctypes import byref, c_char_p, c_double, c_int, c_size_t, c_uint, c_void_p
from fractions import Fraction
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import fleet_slip
from fleet_slip.errors import ConfigError
from fleet_slip.export import fmu
from fleet_slip.export.compile import Sample, angles_by_kernel, compile_program
from fleet_slip.export.files import export_files
from fleet_slip.export.program import Car, Program
from fleet_slip.models.registry import ModelVersion
from tests.export.compiled import needs_cc
from tests.export.models import CARS, MODELS, hostile_drive, model_of
from tests.support.catalog import CATALOG, SIGNALS

pytestmark = needs_cc

TICK_S = 0.01
MANIFEST = model_of(MODELS["every_kind"], Fraction(-1, 700), "any")


@pytest.fixture(scope="module")
def archive() -> bytes:
    return export_files(ModelVersion(1, MANIFEST, "0123" * 16, CATALOG), None, "fmu")[
        "sideslip_any_fmi2.fmu"
    ]


@pytest.fixture
def instance(archive: bytes, tmp_path: Path) -> "Fmu":
    return Fmu(*unpack(archive, tmp_path))


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


def drive(instance: Fmu, program: Program, car: Car, samples: Sequence[Sample]) -> list[int | None]:
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


def test_hostile_drives_give_the_angles_of_the_kernel(instance: Fmu) -> None:
    program = compile_program(CATALOG, MANIFEST)
    for seed, car in enumerate(CARS):
        samples = hostile_drive(program, 200, seed)
        expected = angles_by_kernel(SIGNALS, MANIFEST, program, car, samples)
        assert drive(instance, program, car, samples) == expected


def test_a_step_is_of_whole_ticks_and_a_state_comes_back(instance: Fmu) -> None:
    assert [instance.step(s) for s in (0.01, 0.05, 0.0100000001)] == [0, 0, 0]
    error = 3
    assert [instance.step(s) for s in (0.015, 0.0, -0.01, float("nan"), 1e300)] == [error] * 5
    message = b"the communication step of %g s is not a multiple of %g s"
    assert instance.messages == [(b"car", message)] * 5
    assert not instance.instantiate(b"{another}")
    assert instance.messages[0][0] == b"car"
    state = c_void_p()
    program = compile_program(CATALOG, MANIFEST)
    samples = hostile_drive(program, 60, 1)
    before = drive(instance, program, CARS[1], samples)
    assert instance.call("GetFMUstate", byref(state)) == 0
    columns = [signal.column for signal in program.signals]
    instance.write("Real", columns, [0.5] * len(columns), c_double)
    again = []
    for _ in range(2):
        assert instance.step() == 0
        again.append(instance.read("Real", program.angle.column, c_double))
        assert instance.call("SetFMUstate", state) == 0
        instance.write("Real", columns, [0.5] * len(columns), c_double)
    assert again[0] == again[1]
    assert instance.call("FreeFMUstate", byref(state)) == 0
    assert drive(instance, program, CARS[1], samples) == before


def test_it_says_what_it_is_of_and_is_the_same_again(archive: bytes) -> None:
    version = ModelVersion(1, MANIFEST, "0123" * 16, CATALOG)
    with zipfile.ZipFile(BytesIO(archive)) as file:
        table = file.read("resources/checks.csv").decode()
        text = file.read("modelDescription.xml").decode()
    assert fmu.fmu(version, compile_program(CATALOG, MANIFEST), table) == archive
    assert "any@1, SHA-256 01230123" in text
    assert '<Unit name="m/s^2"><BaseUnit m="1" s="-2"/></Unit>' in text
    assert table.startswith("drive_id,tick,")


def test_without_a_compiler_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fmu, "COMPILER", "no-such-compiler")
    version = ModelVersion(1, model_of(MODELS["signals"]), "0" * 64, CATALOG)
    with pytest.raises(ConfigError, match="the C compiler no-such-compiler"):
        export_files(version, None, "fmu")


@pytest.mark.tools("fmpy")
@pytest.mark.parametrize("name", ["every_kind", "learning"])
def test_fmpy_finds_no_problem(name: str, tmp_path: Path) -> None:
    manifest = model_of(MODELS[name], Fraction(-1, 700), "any")
    content = export_files(ModelVersion(1, manifest, "0" * 64, CATALOG), None, "fmu")
    file = tmp_path / "any.fmu"
    file.write_bytes(content["sideslip_any_fmi2.fmu"])
    assert "No problems found" in run_fmpy("validate", str(file))


def run_fmpy(*words: str) -> str:
    done = subprocess.run(
        ["fmpy", *words], capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.tools("fmpy")
def test_fmpy_drives_a_whole_drive_as_score_does(smoke_root: Path, tmp_path: Path) -> None:
    fleet = fleet_slip.open(smoke_root)
    version = fleet.models.get("smoke")
    program = compile_program(CATALOG, version.manifest)
    log = fleet.sql("SELECT * FROM log WHERE drive_id = 'smoke-2024-05-01-0003' ORDER BY tick").pl()
    fleet.models.export(version, "fmu", tmp_path)
    columns = [one.column for one in program.signals]
    with (tmp_path / "in.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["time", *columns])
        for tick, row in enumerate(log.select(columns).iter_rows()):
            table.writerow([repr(tick * TICK_S), *map(repr, row)])
    words = ["--input-file", str(tmp_path / "in.csv"), "--output-file", str(tmp_path / "out.csv")]
    times = ["--output-interval", str(TICK_S), "--stop-time", str(len(log) * TICK_S)]
    scale = float(program.angle.scale)
    predicted = version.predict(log).to_numpy()
    run_fmpy("simulate", str(tmp_path / "sideslip_smoke_fmi2.fmu"), *words, *times)
    with (tmp_path / "out.csv").open() as file:
        rows = list(csv.DictReader(file))[1:]  # the first is from before the first tick
    angles = [round(float(row["sideslip_rad"]) / scale) for row in rows]
    assert angles == np.floor(predicted / scale + 0.5).astype(int).tolist()


def test_the_readme_lists_inputs_in_si_and_says_when_the_output_comes() -> None:
    version = ModelVersion(1, MANIFEST, "0123" * 16, CATALOG)
    text = export_files(version, None, "fmu")["sideslip_any_fmu_README.md"].decode()
    assert "scale" not in text.partition("## Inputs")[2]
    assert "counts" not in text
    signal = CATALOG.signals.signals["ay"]
    assert f"| `{signal.column}` | m/s^2 | -30.000 to 30.000 |" in text
    assert "from t to t + 0.01 s is the angle of the inputs at t." in text
