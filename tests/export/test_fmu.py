"""Exported FMUs: driven through their binaries here, and by FMPy where it is installed."""

import csv
import ctypes
import subprocess
import zipfile
from collections.abc import Sequence
from ctypes import byref, c_bool, c_char_p, c_double, c_int, c_size_t, c_uint, c_void_p
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
def archives() -> dict[str, bytes]:
    return export_files(ModelVersion(1, MANIFEST, "0123" * 16, CATALOG), None, "fmu")


def unpack(content: bytes, folder: Path) -> tuple[Any, ElementTree.Element]:
    """The library in an FMU, and its description."""
    with zipfile.ZipFile(BytesIO(content)) as archive:
        archive.extractall(folder)
    (library,) = folder.glob("binaries/*/*.so")
    description = ElementTree.parse(folder / "modelDescription.xml")  # noqa: S314 - our own
    return ctypes.CDLL(str(library)), description.getroot()


class Fmu:
    """An instance of an FMU in either version, called as the standard says."""

    def __init__(self, library: Any, description: ElementTree.Element) -> None:
        self.library, self.name = library, f"fmi{description.attrib['fmiVersion'][0]}"
        self.second = self.name == "fmi2"
        token = description.attrib["guid" if self.second else "instantiationToken"].encode()
        self.one = c_void_p(self.instantiate(token))
        self.references = {
            one.attrib["name"]: int(one.attrib["valueReference"])
            for one in description.iter()
            if "valueReference" in one.attrib and "name" in one.attrib
        }

    def instantiate(self, token: bytes) -> Any:
        if self.second:
            call = self.library.fmi2Instantiate
            call.restype = c_void_p
            return call(b"car", c_int(1), c_char_p(token), None, None, c_int(0), c_int(0))
        call = self.library.fmi3InstantiateCoSimulation
        call.restype = c_void_p
        four = [c_bool(False)] * 4
        return call(b"car", c_char_p(token), None, *four, None, c_size_t(0), None, None, None)

    def call(self, what: str, *given: Any) -> int:
        return int(getattr(self.library, self.name + what)(self.one, *given))

    def write(self, kind: str, names: Sequence[str], values: Sequence[Any], number: Any) -> None:
        references = (c_uint * len(names))(*(self.references[name] for name in names))
        array = (number * len(names))(*values)
        room = [] if self.second else [c_size_t(len(names))]
        assert self.call(f"Set{kind}", references, c_size_t(len(names)), array, *room) == 0

    def read(self, kind: str, name: str, number: Any) -> Any:
        value = number()
        room = [] if self.second else [c_size_t(1)]
        reference = c_uint(self.references[name])
        assert self.call(f"Get{kind}", byref(reference), c_size_t(1), byref(value), *room) == 0
        return value.value

    def step(self, step_s: float = TICK_S) -> int:
        given: list[Any] = [c_double(0.0), c_double(step_s)]
        if self.second:
            return self.call("DoStep", *given, c_int(0))
        said: list[Any] = [c_bool(), c_bool(), c_bool(), c_double()]
        return self.call("DoStep", *given, c_bool(False), *[byref(x) for x in said])


def drive(one: Fmu, program: Program, car: Car, samples: Sequence[Sample]) -> list[int | None]:
    """Return the angles that an FMU gives, in counts."""
    told = [*car.fact_counts(program), *car.number_counts(program)]
    names = [fact.field for fact in program.facts] + [number.name for number in program.numbers]
    assert one.call("Reset") == 0
    known = [-(2**31) if n is None else n for n in told]
    one.write("Integer" if one.second else "Int32", names, known, c_int)
    assert one.call("ExitInitializationMode") == 0
    columns = [signal.column for signal in program.signals]
    real, scale = "Real" if one.second else "Float64", float(program.angle.scale)
    found: list[int | None] = []
    for sample in samples:
        values = [
            np.nan if count is None else count * float(signal.scale)
            for count, signal in zip(sample, program.signals, strict=True)
        ]
        one.write(real, columns, values, c_double)
        assert one.step() == 0
        valid = one.read("Boolean", "valid", c_int if one.second else c_bool)
        angle = one.read(real, program.angle.column, c_double)
        assert valid or angle == 0
        found.append(round(angle / scale) if valid else None)
    return found


@pytest.mark.parametrize("fmi", [2, 3])
def test_hostile_drives_give_the_angles_of_the_kernel(
    archives: dict[str, bytes], fmi: int, tmp_path: Path
) -> None:
    one = Fmu(*unpack(archives[f"sideslip_any_fmi{fmi}.fmu"], tmp_path))
    program = compile_program(CATALOG, MANIFEST)
    for seed, car in enumerate(CARS):
        samples = hostile_drive(program, 200, seed)
        expected = angles_by_kernel(SIGNALS, MANIFEST, program, car, samples)
        assert drive(one, program, car, samples) == expected


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_step_is_of_whole_ticks_and_a_state_comes_back(
    archives: dict[str, bytes], fmi: int, tmp_path: Path
) -> None:
    one = Fmu(*unpack(archives[f"sideslip_any_fmi{fmi}.fmu"], tmp_path))
    assert [one.step(s) for s in (0.01, 0.05, 0.0100000001)] == [0, 0, 0]
    error = 3
    assert [one.step(s) for s in (0.015, 0.0, -0.01, float("nan"), 1e300)] == [error] * 5
    assert not one.instantiate(b"{another}")
    state = c_void_p()
    name = "FMUstate" if fmi == 2 else "FMUState"
    program = compile_program(CATALOG, MANIFEST)
    samples = hostile_drive(program, 60, 1)
    before = drive(one, program, CARS[1], samples)
    assert one.call(f"Get{name}", byref(state)) == 0
    real, columns = "Real" if fmi == 2 else "Float64", [s.column for s in program.signals]
    one.write(real, columns, [0.5] * len(columns), c_double)
    again = []
    for _ in range(2):
        assert one.step() == 0
        again.append(one.read(real, program.angle.column, c_double))
        assert one.call(f"Set{name}", state) == 0
        one.write(real, columns, [0.5] * len(columns), c_double)
    assert again[0] == again[1]
    assert one.call(f"Free{name}", byref(state)) == 0
    assert drive(one, program, CARS[1], samples) == before


def test_it_says_what_it_is_of_and_is_the_same_again(archives: dict[str, bytes]) -> None:
    version = ModelVersion(1, MANIFEST, "0123" * 16, CATALOG)
    again = archives["sideslip_any_fmi2.fmu"]
    with zipfile.ZipFile(BytesIO(again)) as archive:
        table = archive.read("resources/checks.csv").decode()
    assert fmu.fmu(version, compile_program(CATALOG, MANIFEST), table, 2) == again
    with zipfile.ZipFile(BytesIO(archives["sideslip_any_fmi2.fmu"])) as archive:
        text = archive.read("modelDescription.xml").decode()
        assert "any@1, SHA-256 01230123" in text
        assert '<Unit name="m/s^2"><BaseUnit m="1" s="-2"/></Unit>' in text
        assert archive.read("resources/checks.csv").startswith(b"drive_id,tick,")


def test_without_a_compiler_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fmu, "COMPILER", "no-such-compiler")
    version = ModelVersion(1, model_of(MODELS["signals"]), "0" * 64, CATALOG)
    with pytest.raises(ConfigError, match="the C compiler no-such-compiler"):
        export_files(version, None, "fmu")


@pytest.mark.tools("fmpy")
@pytest.mark.parametrize("name", MODELS)
def test_fmpy_finds_no_problem(name: str, tmp_path: Path) -> None:
    """Of FMI 2 in two models, which have all that the others have."""
    manifest = model_of(MODELS[name], Fraction(-1, 700), "any")
    content = export_files(ModelVersion(1, manifest, "0" * 64, CATALOG), None, "fmu")
    for fmi in (2, 3) if name in ("every_kind", "learning") else (3,):
        file = tmp_path / f"any{fmi}.fmu"
        file.write_bytes(content[f"sideslip_any_fmi{fmi}.fmu"])
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
    version = fleet.model("smoke")
    program = compile_program(CATALOG, version.manifest)
    log = fleet.sql("SELECT * FROM log WHERE drive_id = 'smoke-2024-05-01-0003' ORDER BY tick").pl()
    fleet.export(version, "fmu", tmp_path)
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
    for fmi in (2, 3):
        run_fmpy("simulate", str(tmp_path / f"sideslip_smoke_fmi{fmi}.fmu"), *words, *times)
        with (tmp_path / "out.csv").open() as file:
            rows = list(csv.DictReader(file))[1:]  # the first is from before the first tick
        found = [round(float(row["sideslip_rad"]) / scale) for row in rows]
        assert found == np.floor(predicted / scale + 0.5).astype(int).tolist()
