"""`fleet-slip predict`: the estimate of log files beside the reference, as a table."""

import random
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow.parquet as pq
import pytest

import fleet_slip
from fleet_slip.errors import DataError, InputError
from tests.support.commands import done_on, run_on
from tests.support.measured import OWN_MAPPING, csv_text, ingest_own, own_columns

WITHOUT_LABEL = OWN_MAPPING.replace('sideslip = { column = "beta", unit = "rad" }\n', "")
WITHOUT_AX = WITHOUT_LABEL.replace('ax = { column = "ax", unit = "m/s^2" }\n', "")


@pytest.fixture(scope="module")
def measured_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a data root that has a model, and with its log of two cars."""
    folder = tmp_path_factory.mktemp("predict")
    ingest_own(folder / "data", folder, cars=2)
    fleet = fleet_slip.open(folder / "data")
    fleet.models.publish("own", fleet.cohort().select(model="ax,ay,yaw_rate"), force=True)
    (folder / "no_label.toml").write_text(WITHOUT_LABEL)
    (folder / "no_ax.toml").write_text(WITHOUT_AX)
    return folder


def predict(
    measured_root: Path, output: Path, *words: str | Path, mapping: str = "own.toml"
) -> list[str]:
    return [
        *(
            "predict",
            "own",
            str(measured_root / "log.csv"),
            "--mapping",
            str(measured_root / mapping),
        ),
        *("--output", str(output), *map(str, words)),
    ]


def test_predictions_are_those_of_the_ingested_log(measured_root: Path, tmp_path: Path) -> None:
    output = tmp_path / "beta.parquet"
    document = done_on(measured_root / "data", *predict(measured_root, output), "--json").json
    table = pq.read_table(output)
    assert table.column_names == [
        "drive_id", "time_s", "sideslip_estimate_deg", "sideslip_reference_deg"
    ]  # fmt: skip
    assert table.schema.metadata[b"model"] == b"own@1"
    fleet = fleet_slip.open(measured_root / "data")
    score = fleet.evaluation.score("own", "true")
    assert "evaluate own@1 --cohort true" in str(score), "its drives are measured"
    assert (document["model"], document["rows"]) == ("own@1", score.rows)
    assert document["rmse_deg"] == pytest.approx(score.rmse_deg, rel=1e-12)
    assert [drive["vehicle_id"] for drive in document["drives"]] == ["car-0", "car-1"]
    logged = fleet.sql("FROM log ORDER BY drive_id, time_s").to_arrow_table()
    assert table["drive_id"].to_pylist() == logged["drive_id"].to_pylist()
    assert table["time_s"].to_pylist() == logged["time_s"].to_pylist()
    estimate = fleet.models.get("own").predict(logged).to_numpy()
    assert np.degrees(estimate) == pytest.approx(table["sideslip_estimate_deg"].to_numpy())
    drives = fleet.sql("SELECT count(*) FROM drives").fetchall()
    assert drives == [(2,)], "nothing is ingested"


def test_csv_and_mdf_have_the_same_numbers_and_no_reference_is_empty(
    measured_root: Path, tmp_path: Path
) -> None:
    mdf = pytest.importorskip("asammdf")
    done_on(
        measured_root / "data", *predict(measured_root, tmp_path / "b.csv", mapping="no_label.toml")
    )
    frame = pl.read_csv(tmp_path / "b.csv")
    assert frame["sideslip_reference_deg"].null_count() == len(frame) == 1000
    done = done_on(
        measured_root / "data", *predict(measured_root, tmp_path / "b.mf4", mapping="no_label.toml")
    )
    assert f"written to {tmp_path / 'b.mf4'}" in done.stderr
    with mdf.MDF(tmp_path / "b.mf4") as file:
        groups = [file.get("sideslip_estimate", group=group) for group in range(2)]
        assert [entry.channel_group.acq_name for entry in file.groups] == frame["drive_id"].unique(
            maintain_order=True
        ).to_list()
        assert file.groups[0].channels[0].name == "time"
    assert groups[0].unit == "deg"
    values = np.concatenate([group.samples for group in groups])
    assert values == pytest.approx(frame["sideslip_estimate_deg"].to_numpy())
    times = np.concatenate([group.timestamps for group in groups])
    assert times == pytest.approx(frame["time_s"].to_numpy())


def test_nothing_is_overwritten_without_being_asked(measured_root: Path, tmp_path: Path) -> None:
    output = tmp_path / "beta.csv"
    output.write_text("mine")
    refused = run_on(measured_root / "data", *predict(measured_root, output))
    assert refused.exit_code == 2 and "--replace" in refused.stderr
    assert output.read_text() == "mine"
    done_on(measured_root / "data", *predict(measured_root, output, "--replace"))
    assert output.read_text().startswith("drive_id,")


def test_logs_that_cannot_be_predicted_are_refused_and_nothing_is_written(
    measured_root: Path, tmp_path: Path
) -> None:
    unknown = run_on(measured_root / "data", *predict(measured_root, tmp_path / "beta.xlsx"))
    assert unknown.exit_code == 2 and ".parquet, .csv, .mf4" in unknown.stderr
    output = tmp_path / "beta.csv"
    lacking = run_on(measured_root / "data", *predict(measured_root, output, mapping="no_ax.toml"))
    assert lacking.exit_code == DataError.exit_code
    assert "own@1 needs ax, which the mapping own lacks" in lacking.stderr
    rng = random.Random(1)  # noqa: S311
    columns = own_columns(rng) | {"car": ["car-0"] * 500}
    empty = tmp_path / "empty.csv"
    empty.write_text(csv_text({**columns, "ax": [None] * 500}))
    words = ["predict", "own", str(empty), "--mapping", str(measured_root / "own.toml")]
    none = run_on(measured_root / "data", *words, "--output", str(output))
    assert none.exit_code == DataError.exit_code and "no row of the logs has all of" in none.stderr
    assert not output.exists()


def test_no_log_is_overwritten_and_no_drive_is_predicted_twice(
    measured_root: Path, tmp_path: Path
) -> None:
    log = (measured_root / "log.csv").read_text()
    refused = run_on(
        measured_root / "data", *predict(measured_root, measured_root / "log.csv", "--replace")
    )
    assert refused.exit_code == 2 and "log.csv is one of the logs" in refused.stderr
    assert (measured_root / "log.csv").read_text() == log
    output = tmp_path / "beta.csv"
    done_on(measured_root / "data", *predict(measured_root, output, measured_root / "log.csv"))
    assert len(pl.read_csv(output)) == 1000, "a log that is named twice counts once"
    output.unlink()
    copy = tmp_path / "log.csv"
    copy.write_text(log)
    repeated = run_on(measured_root / "data", *predict(measured_root, output, copy))
    assert repeated.exit_code == InputError.exit_code and "is also in" in repeated.stderr
    assert not output.exists()


def test_a_log_without_the_reference_of_its_mapping_is_predicted(
    measured_root: Path, tmp_path: Path
) -> None:
    lines = (measured_root / "log.csv").read_text().splitlines()
    place = lines[0].split(",").index("beta")
    rows = [",".join(c for i, c in enumerate(x.split(",")) if i != place) for x in lines]
    (tmp_path / "plain.csv").write_text("\n".join(rows) + "\n")
    log, mapping = str(tmp_path / "plain.csv"), str(measured_root / "own.toml")
    words = ("predict", "own", log, "--mapping", mapping, "--output", str(tmp_path / "b.parquet"))
    done = done_on(measured_root / "data", *words)
    assert "no reference:" in done.stderr and "no column 'beta'" in done.stderr
    frame = pl.read_parquet(tmp_path / "b.parquet")
    assert frame["sideslip_reference_deg"].null_count() == len(frame) == 1000
    assert frame["sideslip_estimate_deg"].null_count() < 10
