"""Exported FMUs: driven through their binaries here, and by FMPy where it is installed."""

import zipfile
from ctypes import byref, c_double, c_void_p
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

import fleet_slip
from fleet_slip.errors import ConfigError
from fleet_slip.export import files as export
from fleet_slip.export.files import export_files
from fleet_slip.export.stepping import angles_by_kernel, compile_program
from fleet_slip.models.registry import ModelVersion
from tests.export.compiled import needs_cc
from tests.export.fmus import Fmu, drive_fmu, run_fmpy, simulate_with_fmpy, unpack
from tests.export.models import BLENDS, CARS, hostile_drive, version_of
from tests.support.catalog import CATALOG, SIGNALS

pytestmark = needs_cc


@pytest.fixture(scope="module")
def version(request: pytest.FixtureRequest) -> ModelVersion:
    return version_of(getattr(request, "param", "every_kind"))


@pytest.fixture(scope="module")
def archive(version: ModelVersion) -> bytes:
    return fmu_of(version)


def fmu_of(version: ModelVersion) -> bytes:
    return export_files(version, None, "fmu")[f"sideslip_{version.manifest.name}_fmi2.fmu"]


@pytest.fixture
def instance(archive: bytes, tmp_path: Path) -> Fmu:
    return Fmu(*unpack(archive, tmp_path))


LONG = [pytest.param(name, marks=pytest.mark.long) for name in BLENDS]


@pytest.mark.parametrize("version", ["every_kind", *LONG], indirect=True)
def test_hostile_drives_give_the_angles_of_the_kernel(instance: Fmu, version: ModelVersion) -> None:
    program = compile_program(CATALOG, version.manifest)
    for seed, car in enumerate(CARS):
        samples = hostile_drive(program, 200, seed)
        expected = angles_by_kernel(
            SIGNALS, version.manifest, program, car.facts, car.numbers, samples
        )
        assert drive_fmu(instance, program, car, samples) == expected


def test_a_step_is_of_whole_ticks_and_a_state_comes_back(
    instance: Fmu, version: ModelVersion
) -> None:
    assert [instance.step(s) for s in (0.01, 0.05, 0.0100000001)] == [0, 0, 0]
    error = 3
    assert [instance.step(s) for s in (0.015, 0.0, -0.01, float("nan"), 1e300)] == [error] * 5
    message = b"the communication step of %g s is not a multiple of %g s"
    assert instance.messages == [(b"car", message)] * 5
    assert not instance.instantiate(b"{another}")
    assert instance.messages[0][0] == b"car"
    state = c_void_p()
    program = compile_program(CATALOG, version.manifest)
    samples = hostile_drive(program, 60, 1)
    before = drive_fmu(instance, program, CARS[1], samples)
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
    assert drive_fmu(instance, program, CARS[1], samples) == before


def test_it_says_what_it_is_of_and_is_the_same_again(archive: bytes, version: ModelVersion) -> None:
    with zipfile.ZipFile(BytesIO(archive)) as file:
        table = file.read("resources/checks.csv").decode()
        text = file.read("modelDescription.xml").decode()
    assert fmu_of(version) == archive
    assert "every_kind@1, SHA-256 01230123" in text
    assert '<Unit name="m/s^2"><BaseUnit m="1" s="-2"/></Unit>' in text
    assert table.startswith("drive_id,tick,")


def test_without_a_compiler_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export, "COMPILER", "no-such-compiler")
    version = version_of("signals")
    with pytest.raises(ConfigError, match="the C compiler no-such-compiler"):
        export_files(version, None, "fmu")


@pytest.mark.tools("fmpy")
@pytest.mark.parametrize("name", ["every_kind", "learning", "by_lateral"])
def test_fmpy_finds_no_problem(name: str, tmp_path: Path) -> None:
    file = tmp_path / "any.fmu"
    file.write_bytes(fmu_of(version_of(name)))
    assert "No problems found" in run_fmpy("validate", str(file))


@pytest.mark.tools("fmpy")
def test_fmpy_drives_a_whole_drive_as_score_does(smoke_root: Path, tmp_path: Path) -> None:
    fleet = fleet_slip.open(smoke_root)
    version = fleet.models.get("smoke")
    program = compile_program(CATALOG, version.manifest)
    log = fleet.sql("SELECT * FROM log WHERE drive_id = 'smoke-2024-05-01-0003' ORDER BY tick").pl()
    fleet.models.export(version, "fmu", tmp_path)
    columns = [signal.column for signal in program.signals]
    scale = float(program.angle.scale)
    predicted = version.predict(log).to_numpy()
    file, rows = tmp_path / "sideslip_smoke_fmi2.fmu", log.select(columns).rows()
    outputs = simulate_with_fmpy(file, columns, rows, "sideslip_rad")
    angles = [round(angle / scale) for angle in outputs]
    assert angles == np.floor(predicted / scale + 0.5).astype(int).tolist()


def test_the_readme_lists_inputs_in_si_and_says_when_the_output_comes(
    version: ModelVersion,
) -> None:
    text = export_files(version, None, "fmu")["sideslip_every_kind_fmu_README.md"].decode()
    assert "scale" not in text.partition("## Inputs")[2]
    assert "counts" not in text
    signal = CATALOG.signals.signals["ay"]
    assert f"| `{signal.column}` | m/s^2 | -30.000 to 30.000 |" in text
    assert "from t to t + 0.01 s is the angle of the inputs at t." in text
