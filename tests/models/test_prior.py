"""`--prior`: simulated drives join the training; `--half-life`: old drives count less."""

from collections.abc import Callable
from datetime import date, timedelta
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import fleet_slip
from fleet_slip.api.fleet import Fleet
from fleet_slip.arrays import FloatArray
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.evaluation import measured_evaluation as module
from fleet_slip.evaluation.identify import FitParameters, IdentifiedVehicle, vehicle_with_fit
from fleet_slip.evaluation.measured_evaluation import identified_prior
from fleet_slip.grams.cohort import load_cohort
from fleet_slip.grams.update import update_grams
from fleet_slip.models.prior import simulate_prior
from fleet_slip.models.request import SelectionPlan, SelectionRequest, load_model_list
from fleet_slip.models.select import keeps_prior
from fleet_slip.regression.gram import Gram
from fleet_slip.regression.least_squares import fit
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.campaign import load_campaign
from fleet_slip.storage.local import LocalFolder
from fleet_slip.vehicle.parameters import VehicleMeasures
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.commands import RunCommand, done_on, run_on
from tests.support.counts import gram_of
from tests.support.logs import land, log_rows
from tests.support.measured import ingest_own
from tests.support.model_lists import nested, write_list
from tests.support.reported import answer

INPUTS = "ax,ay,yaw_rate"
FEW = """
name = "few"
description = "A few drives of a prior"
base = "prior"
number_of_days = 1
drives_per_day = 2

[plan]
tracks = ["city_1"]
"""


@pytest.fixture(scope="module")
def simulated_prior(tmp_path_factory: pytest.TempPathFactory) -> str:
    file = tmp_path_factory.mktemp("prior") / "few.toml"
    file.write_text(FEW)
    return str(file)


@pytest.fixture(scope="module")
def measured_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("own")
    ingest_own(folder / "data", folder, cars=6)
    return folder / "data"


def with_mark(gram: Gram, mark: int) -> Gram:
    """Return the Gram with one more column, which is `mark` in every row."""
    sums, products = (*gram.sums, mark * gram.n), tuple(mark * value for value in gram.sums)
    return Gram((*gram.signals, "mark"), gram.n, sums, (*gram.products, *products, mark * gram.n))


def test_a_prior_is_weighed_exactly_and_has_an_intercept_of_its_own(
    measured_root: Path, simulated_prior: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fleet_slip.models.select.PRIOR_SHARE", Fraction(1, 2**20))
    fleet = fleet_slip.open(measured_root)
    selection = fleet.cohort().select(model=INPUTS, prior=simulated_prior)
    prior = simulate_prior(CATALOG, simulated_prior, "signals")
    weight = selection.cohort.weight
    signals = (*INPUTS.split(","), SIGNALS.label)
    (simulated,) = prior.tables
    real = (
        load_cohort(fleet.warehouse)
        .complete_cases(INPUTS.split(","))
        .table.total()
        .restrict(signals)
    )
    both = with_mark(real, 1).scaled(weight.denominator)
    both += with_mark(simulated.total().restrict(signals), 0).scaled(weight.numerator)
    assert 0 < weight < 1
    assert selection.as_dict()["prior"] == {"campaign": simulated_prior, "weight": str(weight)}
    by_hand = fit(both, [*INPUTS.split(","), "mark"], SIGNALS.label).model
    counts = selection.winner.model.counts
    assert [*counts.weights.values()] == [by_hand.weights[name] for name in counts.weights]
    assert counts.offset == pytest.approx(by_hand.offset + by_hand.weights["mark"], rel=1e-12)
    assert prior.rows > 1000 and selection.cohort.drive_count == 6


def test_a_version_names_its_prior_and_is_trained_so_again(
    measured_root: Path, simulated_prior: str, tmp_path: Path
) -> None:
    models = write_list(tmp_path / "own.toml", INPUTS)
    publication = done_on(
        measured_root, "publish", "with", "--models", models, "--prior", simulated_prior, "--force"
    )
    fleet = fleet_slip.open(measured_root)
    manifest = fleet.models.get("with").manifest
    assert manifest.prior is not None
    assert (manifest.prior.campaign, manifest.prior.drives) == ("few", 2)
    assert manifest.prior.campaign_sha256 == load_campaign(simulated_prior, SHIPPED_CONFIGS).digest
    assert manifest.trained_on.drives == 6, "those of the cohort"
    assert "few: 2 simulated drives" in done_on(measured_root, "show", "with").stdout
    assert "The prior is not used" in publication.stdout, "it costs a tenth of the error"
    again = answer(measured_root, "publish", "with")
    assert not again["new"], "it is trained as it was, to the same bits"
    half = ("--half-life", "30", "--force")
    two = write_list(tmp_path / "two.toml", "ay,yaw_rate")
    done_on(measured_root, "publish", "with", "--models", two, *half)
    facts = answer(measured_root, "diff", "with@1", "with@2")["facts"]
    assert facts["prior.campaign"] == {"one": "few", "other": None}
    assert facts["selected_by.asked.half_life"]["other"] == 30
    drives = answer(measured_root, "sql", "SELECT DISTINCT source FROM drives")
    assert "simulated" not in str(drives), "it is not in the warehouse"


@pytest.mark.parametrize(
    "words",
    [
        ("--order", "ay,yaw_rate"),
        ("--ranking", "forward"),
        ("--label", "course"),
    ],
)
def test_options_that_exclude_a_prior_are_refused(
    measured_root: Path, simulated_prior: str, words: tuple[str, ...]
) -> None:
    done = run_on(measured_root, "select", "--prior", simulated_prior, *words)
    assert done.exit_code == 2
    assert "a prior works with" in done.stderr
    unknown = run_on(measured_root, "select", "--model", INPUTS, "--prior", "nowhere")
    assert unknown.exit_code == 3
    assert "nowhere" in unknown.stderr


def test_a_wrong_prior_is_not_used(
    measured_root: Path, simulated_prior: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its label is reversed: whatever is taken of it makes held-out drives worse."""
    prior = simulate_prior(CATALOG, simulated_prior, "signals")
    (table,) = prior.tables
    label = table.signals.index(SIGNALS.label)
    sums, products = table.sums.copy(), table.products.copy()
    sums[:, label] *= -1
    rows = label * (label + 1) // 2 + np.arange(label)
    products[:, rows] *= -1
    wrong = type(table)(table.signals, table.n, sums, products)
    reversed_prior = prior.__class__(**{**vars(prior), "tables": (wrong,)})
    monkeypatch.setattr("fleet_slip.models.prior.simulate_prior", lambda *_: reversed_prior)
    selection = fleet_slip.open(measured_root).cohort().select(model=INPUTS, prior=simulated_prior)
    assert selection.cohort.weight == 0 and "The prior is not used" in selection.winner.reason
    assert (
        selection.winner.model.counts
        == fleet_slip.open(measured_root).cohort().select(model=INPUTS).winner.model.counts
    )


def test_a_prior_may_cost_a_tenth_on_held_out_drives_and_less_on_many() -> None:
    assert keeps_prior(0.154, 0.147, drives=9), "a good prior on a real car"
    assert not keeps_prior(2.16, 1.63, drives=3)
    assert not keeps_prior(1.05, 1.0, drives=40)


def test_in_an_evaluation_the_car_of_a_prior_is_identified_anew(
    measured_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The car of the prior must not be identified from held-out drives."""
    car = VehicleMeasures(name="own", mass_kg=1500, front_axle_m=1.2, rear_axle_m=1.5)
    seen: list[int] = []
    simulated: list[float] = []

    def identify(
        measured: VehicleMeasures, drives: list[object], executor: object
    ) -> IdentifiedVehicle:
        seen.append(len(drives))
        fitted = FitParameters(stiffness_rear=1.0 + len(seen) / 100)
        return IdentifiedVehicle(vehicle_with_fit(measured, fitted), fitted.noise, 0.0)

    def simulate(_: Catalog, campaign: object, feature_set: str, executor: object) -> object:
        vehicle = identified_prior(campaign)  # type: ignore[arg-type]
        assert vehicle is not None
        simulated.append(vehicle.suspension.rear_stiffness_factor)
        return prior

    identified = IdentifiedVehicle(vehicle_with_fit(car), FitParameters().noise, 0.0)
    file = tmp_path / "own.toml"
    file.write_text(identified.as_campaign())
    campaign = load_campaign(str(file), SHIPPED_CONFIGS)
    assert identified_prior(campaign) == identified.car
    few_drives = campaign.model_copy(update={"number_of_days": 1, "drives_per_day": 2})
    prior = simulate_prior(CATALOG, few_drives, "signals")
    monkeypatch.setattr("fleet_slip.models.prior.simulate_prior", lambda *_: prior)
    models = write_list(tmp_path / "list.toml", INPUTS)
    done_on(measured_root, "publish", "identified", "--models", models, "--prior", file, "--force")
    monkeypatch.setattr(module, "identify", identify)
    monkeypatch.setattr(module, "simulate_prior", simulate)
    monkeypatch.setattr(module, "FILTERS", ())
    fleet = fleet_slip.open(measured_root)
    content = fleet.evaluation.evaluate_measured("identified", "true").content
    assert content["vehicle"] == "own", "it brings its car along"
    assert set(seen) == {5} and len(seen) == content["parts"]
    assert len(set(simulated)) == len(simulated) == content["parts"]


def test_a_prior_in_which_every_car_is_lost_is_refused(
    measured_root: Path, simulated_prior: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fleet_slip.models.prior.NOT_LOST", "lost_control_s < 0")
    done = run_on(measured_root, "select", "--model", INPUTS, "--prior", simulated_prior)
    assert done.exit_code == 5
    assert "prior few: the driver lost control in all drives" in done.stderr


def test_a_usual_choice_with_other_weights_is_of_the_usual_list() -> None:
    """An evaluation makes it again by the recipe, which names no list."""
    usual = SelectionPlan.from_request(CATALOG, SelectionRequest(half_life=90))
    assert usual.candidate_list == load_model_list(CATALOG, "estimator")
    logged = SelectionPlan.from_request(CATALOG, SelectionRequest(features="signals", robust=True))
    assert logged.candidate_list == load_model_list(CATALOG, "table1")


TWO = "ay,yaw_rate"
LIAR = "it's me"
Label = Callable[[int, FloatArray], FloatArray]


def land_drives(
    root: Path, number: int, seed: int, label: Label, *, is_daily: bool = False
) -> list[np.ndarray]:
    """Land drives of a hundred rows, ten days apart if daily; return ay, yaw rate and label."""
    random, result = np.random.default_rng(seed), []
    warehouse = Warehouse(LocalFolder(root))
    for drive in range(number):
        ay, yaw_rate = random.integers(-3000, 3000, (2, 100))
        truth = 0.05 * ay - 0.02 * yaw_rate
        columns = [ay, yaw_rate, np.rint(label(drive, truth) + random.normal(0, 10, 100))]
        counts = dict(zip(("ay", "yaw_rate", "sideslip"), columns, strict=True))
        rows = log_rows(
            f"d{drive:02d}",
            {name: values.astype(np.int16) for name, values in counts.items()},
            vehicle_id=LIAR if drive == 6 else f"car-{drive:02d}",
        )
        day = date(2026, 5, 1) + timedelta(days=10 * drive if is_daily else 0)
        land(warehouse, f"d{drive}", rows, day=day)
        result.append(np.column_stack(columns).astype(np.int64))
    update_grams(warehouse)
    return result


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    """Twenty-five cars, one of which has the sign of its label reversed."""
    land_drives(
        tmp_path / "data", 25, 2, lambda drive, truth: (-1 if drive == 6 else 1) * truth + drive % 3
    )
    return fleet_slip.open(tmp_path / "data")


def test_old_drives_count_less(tmp_path: Path) -> None:
    """By rows: each of a drive of today sixteen times, of one a half-life ago eight times."""
    drives = land_drives(
        tmp_path / "data", 3, 1, lambda drive, truth: (1 + 0.2 * drive) * truth, is_daily=True
    )
    selection = fleet_slip.open(tmp_path / "data").cohort().select(model=TWO, half_life=10)
    weighted_rows = np.concatenate([np.repeat(d, 4 * 2**i, axis=0) for i, d in enumerate(drives)])
    inputs = np.column_stack([weighted_rows[:, :2], np.ones(len(weighted_rows))])
    slopes = np.linalg.lstsq(inputs, weighted_rows[:, 2], rcond=None)[0]
    assert [*selection.winner.model.counts.weights.values()] == pytest.approx(slopes[:2])
    assert selection.trained_rows == 175
    refused = run_on(tmp_path / "data", "select", "--model", TWO, "--half-life", "0")
    assert refused.exit_code == 2 and "half_life" in refused.stderr


def test_a_drive_that_counts_partly_is_a_part_of_its_rows(tmp_path: Path) -> None:
    """By rows: each of the usual drives sixteen times, the noisy one as often as it counts."""
    noise = np.random.default_rng(4).normal(0, 60, 100)
    drives = land_drives(
        tmp_path / "data", 12, 4, lambda drive, truth: truth + (noise if drive == 5 else 0)
    )
    selection = fleet_slip.open(tmp_path / "data").cohort().select(model=TWO, robust=True)
    assert list(selection.weighted) == ["d05"] and 0 < selection.weighted["d05"].weight < 1
    part = round(16 * selection.weighted["d05"].weight)
    assert selection.trained_rows == (1100 * 16 + 100 * part) // 16
    repeated = [np.repeat(rows, part if i == 5 else 16, axis=0) for i, rows in enumerate(drives)]
    slopes = fit(gram_of(np.concatenate(repeated)), ["x1", "x2"], "y").model.weights
    assert [*selection.winner.model.counts.weights.values()] == [*slopes.values()]


def test_the_liar_counts_for_nothing_and_the_model_is_that_of_the_others(fleet: Fleet) -> None:
    robust = fleet.cohort().select(order=TWO, robust=True)
    assert list(robust.weighted) == ["d06"]
    assert robust.weighted["d06"].times > 10 and robust.weighted["d06"].weight == 0
    honest = fleet.cohort("vehicle_id <> 'it''s me'").select(order=TWO, robust=True)
    assert honest.weighted == {}
    assert robust.winner.model.model == honest.winner.model.model
    plain = fleet.cohort().select(order=TWO)
    assert plain.winner.model.pooled.rmse_deg > 2 * robust.winner.model.pooled.rmse_deg
    assert plain.as_dict()["drives"] == 1 + robust.as_dict()["drives"]


def test_the_command_names_it_and_the_version_keeps_how(
    fleet: Fleet, run_command: RunCommand, tmp_path: Path
) -> None:
    selection = run_command("select", "--order", TWO, "--robust")
    assert selection.exit_code == 0
    assert "d06: its error is " in selection.stderr and "the weight 0.00" in selection.stderr
    before = run_command("diagnose", "--signals", TWO)
    assert "d06: its error is " in before.stderr
    before_json = run_command("diagnose", "--signals", TWO, "--json").json
    assert list(before_json["drives_weighed"]) == ["d06"]
    document = run_command("select", "--order", TWO, "--robust", "--json").json
    assert document["drives_weighed"]["d06"]["weight"] == 0
    models = write_list(tmp_path / "own.toml", *nested(TWO))
    publication = run_command("publish", "safe", "--models", models, "--robust", "--force")
    assert publication.exit_code == 0, publication.stderr
    manifest = fleet.models.get("safe").manifest
    assert manifest.selected_by.options is not None and manifest.selected_by.options["robust"]
    assert (manifest.trained_on.drives, manifest.trained_on.rows) == (24, 2400)
    again = run_command("publish", "safe", "--json")
    assert not again.json["new"], "it is trained as it was"
