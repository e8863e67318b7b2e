"""Conditions of a champion: above the floor, no worse than the current one, or set by a person."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import fleet_slip
from fleet_slip.errors import ConfigError, RefusedError, StorageError
from fleet_slip.models import acceptance as champion_rules
from fleet_slip.models.publish import manifest_of, publish_challenger
from fleet_slip.models.registry import CANDIDATE, ModelVersion, Registry
from fleet_slip.models.request import SelectionRequest
from fleet_slip.models.select import run_selection
from fleet_slip.models.summary import Selection
from fleet_slip.operations.forget import forget, models_trained_on
from fleet_slip.regression.folds import cross_validate, held_out_errors, least_squares
from fleet_slip.regression.least_squares import fit
from fleet_slip.regression.orders import stepwise_order
from fleet_slip.resources import Configs
from fleet_slip.storage.local import LocalFolder
from fleet_slip.warehouse.erasure_log import ErasureSubject
from fleet_slip.warehouse.warehouse import Warehouse
from tests.support.catalog import CATALOG, SIGNALS
from tests.support.champions import CHOICE, ROWS, WEAK, publish_from, registry_of, write

LABEL = SIGNALS.label


def compare(selection: Selection, champion: ModelVersion) -> champion_rules.Comparison:
    """Compare the winner of a selection with a version on all rows."""
    evaluation = champion_rules.ChallengerEvaluation.prepare(selection, champion)
    groups = evaluation.groups(selection.cohort)
    return evaluation.compare(groups, groups)


def copy(root: Path, folder: Path) -> Warehouse:
    return Warehouse(LocalFolder(Path(shutil.copytree(root, folder / "data"))))


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """A root with 48 drives, one with a champion of them, too, and then 48 more. Copy them."""
    folder = tmp_path_factory.mktemp("roots")
    write(Warehouse(LocalFolder(folder / "data")), "good", 48)
    warehouse = copy(folder / "data", folder / "champion")
    assert publish_from(warehouse).version.version == 1
    more = copy(folder / "champion" / "data", folder / "more")
    write(more, "more", 48)
    return folder / "data", Path(str(warehouse.root)), Path(str(more.root))


@pytest.fixture
def drives(roots: tuple[Path, ...], tmp_path: Path) -> Warehouse:
    """A warehouse of 48 drives."""
    return copy(roots[0], tmp_path)


@pytest.fixture
def champion(roots: tuple[Path, ...], tmp_path: Path) -> Warehouse:
    """A warehouse of 48 drives, and a champion of all of them."""
    return copy(roots[1], tmp_path)


@pytest.fixture
def more(roots: tuple[Path, ...], tmp_path: Path) -> Warehouse:
    """The same with as many drives that are new to the champion."""
    return copy(roots[2], tmp_path)


def test_a_reversed_label_is_no_champion(champion: Warehouse) -> None:
    write(champion, "reversed", 48, label=-1.0)
    with pytest.raises(RefusedError, match=r"its correlation is .*, below 0\.5"):
        publish_from(champion)
    alone = "drive_id LIKE 'reversed%'"
    with pytest.raises(RefusedError, match=r"opposite sign of .* of beta@1\. Is it reversed"):
        publish_from(champion, alone)
    assert registry_of(champion).versions("beta") == [1]


def test_models_above_the_floor_must_be_as_good_as_the_coefficients_of_the_champion(
    champion: Warehouse,
) -> None:
    write(champion, "again", 48)
    message = r"beta@1 as published has .* deg and .*, difference \d\.\d{4} \+- \S+ deg\."
    with pytest.raises(RefusedError, match=message):
        publish_from(champion, "drive_id LIKE 'again%' OR drive_id LIKE 'good%'", "ay")


@pytest.mark.parametrize(
    ("drives", "message"),
    [
        (8, r"differ from its training set\. .* of 8 drives that are new to both"),
        (4, r"only from unusual new drives, .*: on its training set, .* of 48 drives, held out"),
    ],
)
def test_a_model_that_is_better_on_odd_new_drives_alone_waits(
    champion: Warehouse, drives: int, message: str
) -> None:
    write(champion, "odd", drives, label=1.25)
    with pytest.raises(RefusedError, match=message):
        publish_from(champion)
    waiting = publish_from(champion, candidate=True)
    assert waiting.candidate and registry_of(champion).champion("beta") != waiting.version


def test_no_champion_falls_while_the_drives_that_made_it_cannot_be_read(
    champion: Warehouse,
) -> None:
    """With a flipped bit there, what is better on odd drives alone became champion."""
    write(champion, "odd", 8, label=1.25)
    (document,) = Path(str(registry_of(champion).versions_of("beta").folder)).glob("drives-*.bin")
    document.write_bytes(document.read_bytes()[:-1] + b"x")
    with pytest.raises(
        RefusedError, match=r"no comparison without the champion's training set: .*checksum"
    ):
        publish_from(champion)
    with pytest.raises(StorageError, match="checksum"):
        fleet_slip.open(str(champion.root)).models.publish(
            "beta", run_selection(champion, SelectionRequest(order="ay,yaw_rate"))
        )
    assert publish_from(champion, force=True).new


def test_few_drives_are_no_reason_to_replace_a_champion_of_many(champion: Warehouse) -> None:
    predicate = (
        "drive_id IN ('good-0','good-1','good-2','good-3','good-4','good-5','good-6','good-9')"
    )
    with pytest.raises(RefusedError, match=r"on 8 drives, fewer than 24 .50% of the champion's 48"):
        publish_from(champion, predicate)
    assert publish_from(champion, predicate, force=True).new


def test_more_data_of_the_same_replaces_the_champion_and_says_what_was_compared(
    more: Warehouse,
) -> None:
    done = publish_from(more)
    assert done.version.version == 2
    assert "rows of 48 drives that are new to both, held out in 8 groups by vehicle" in done.reason
    assert "beta@1 as published has" in done.reason


def test_the_champion_is_compared_as_it_is_not_fitted_anew(more: Warehouse) -> None:
    version = registry_of(more).load("beta", 1)
    request = SelectionRequest(order="ay,yaw_rate")
    answer = run_selection(more, request, "drive_id LIKE 'more%'")
    comparison = compare(answer, version)
    frozen = comparison.champion
    assert frozen.counts.coefficients == version.manifest.counts_model(CATALOG).coefficients
    assert frozen.pooled.rows == comparison.challenger.pooled.rows == 48 * ROWS


def test_a_champion_has_no_advantage_on_drives_that_made_it(
    warehouse: Warehouse, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Few rows, many columns: on its own drives the champion is better than any held-out model."""
    monkeypatch.setattr("tests.models.acceptance.test_champion_rules.ROWS", 12)
    strict = champion_rules.load_thresholds(CATALOG.configs).model_copy(update={"tolerance_deg": 0})
    monkeypatch.setattr(champion_rules, "load_thresholds", lambda _: strict)
    signals = ",".join((*CHOICE, *WEAK))
    write(warehouse, "good", 48, noise=400.0)
    first = run_selection(warehouse, SelectionRequest(model=signals))
    challenger = publish_challenger(
        registry_of(warehouse), manifest_of(first, "beta"), first, force=True
    )
    write(warehouse, "more", 16, noise=400.0)
    version, answer = challenger.version, run_selection(warehouse, SelectionRequest(model=signals))
    assert not compare(answer, version).gap.negligible
    judged = champion_rules.review_challenger(
        registry_of(warehouse), version, manifest_of(answer, "beta"), answer
    )
    assert "16 drives that are new to both" in judged.reason
    assert not judged.problems


def test_a_search_is_made_again_without_the_cars_that_are_held_out(champion: Warehouse) -> None:
    """Columns chosen with the held-out cars in view would flatter the challenger."""
    version = registry_of(champion).load("beta", 1)
    request = SelectionRequest(order=",".join(CHOICE), search="forward", max_features=4)
    answer = run_selection(champion, request)
    winner = next(model for model in answer.models if len(model.signals) == 4)
    answer = replace(answer, winner=replace(answer.winner, model=winner))
    challenger = compare(answer, version).challenger
    groups = answer.cohort.folds("vehicle", champion_rules.MAX_GROUPS).complete_cases(CHOICE, LABEL)
    assert challenger.fold_names == groups.names
    for figures, (training, test) in zip(challenger.folds, groups.splits(), strict=True):
        sets = stepwise_order(training, CHOICE, LABEL, "forward", len(winner.signals))
        model = fit(training, sets[-1], LABEL).model
        scale = CATALOG.input_scales[LABEL]
        assert figures.rmse == held_out_errors(model, training, test).figures(scale).rmse
    fixed = cross_validate(
        "fixed", groups, least_squares(winner.signals, LABEL), CATALOG.input_scales
    )
    assert challenger.pooled.rmse > fixed.pooled.rmse


@pytest.mark.parametrize(("cars", "by", "groups"), [(8, "vehicle", 8), (4, "drive", 18)])
def test_cars_are_held_out_where_there_are_several_else_drives(
    warehouse: Warehouse, cars: int, by: str, groups: int
) -> None:
    write(warehouse, "good", 60)
    cohort = " OR ".join(f"vehicle_id = 'car-{i}'" for i in range(cars))
    version = publish_from(warehouse, cohort).version
    request = SelectionRequest(order="ay,yaw_rate")
    comparison = compare(run_selection(warehouse, request, cohort), version)
    assert (comparison.by, len(comparison.challenger.folds)) == (by, groups)


def test_small_steps_do_not_lead_downhill(drives: Warehouse) -> None:
    strong, registry = "ay,yaw_rate", registry_of(drives)
    first = ",".join((strong, *WEAK))
    assert publish_from(drives, signals=first).version.version == 1
    second = ",".join((strong, *WEAK[:2]))
    stays = publish_from(drives, signals=second)  # it loses 0.0024 +- 0.0002 deg
    assert (stays.version.version, stays.new) == (1, False)
    assert stays.reason.startswith("The champion stays: it is significantly better.")
    assert publish_from(drives, signals=second, force=True).version.version == 2
    third = ",".join((strong, *WEAK[:1]))
    stays = publish_from(drives, signals=third)
    assert (stays.version.version, stays.new) == (2, False)
    assert publish_from(drives, signals=third, force=True).version.version == 3
    assert registry.rollback("beta", "champion") == 2


@pytest.mark.parametrize(
    ("floor", "problem"),
    [
        ("max_rmse_deg = 0.01", "above 0.01 deg"),
        ("min_drives = 49", "on 48 drives, fewer than 49"),
        ("min_vehicles = 9", "on 8 cars, fewer than 9"),
        ("min_correlation = 0.99999", "below 0.99999"),
    ],
)
def test_a_person_sets_the_floor(
    drives: Warehouse, tmp_path: Path, floor: str, problem: str
) -> None:
    usual = (Path(__file__).parents[3] / "configs" / "publish.toml").read_text()
    name = floor.partition(" ")[0]
    text = "\n".join(line for line in usual.splitlines() if not line.startswith(name))
    config_folder = tmp_path / "own"
    config_folder.mkdir()
    (config_folder / "publish.toml").write_text(f"{text}\n{floor}\n")
    with pytest.raises(RefusedError, match=problem):
        publish_from(Warehouse(drives.root, Configs(config_folder)))


def test_a_floor_that_cannot_be_read_lets_nothing_pass(more: Warehouse, tmp_path: Path) -> None:
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "publish.toml").write_text("min_drives = 49\n")
    with pytest.raises(ConfigError, match=r"publish\.toml"):
        publish_from(Warehouse(more.root, Configs(tmp_path / "own")), force=True)


def hold_by_rollback(registry: Registry) -> None:
    registry.rollback("beta", "champion")


def hold_by_pin(registry: Registry) -> None:
    registry.promote("beta", 1, "champion")
    registry.hold("beta", "champion", "pin")


@pytest.mark.parametrize("hold", [hold_by_rollback, hold_by_pin])
def test_a_champion_that_people_chose_stays(
    more: Warehouse, hold: Callable[[Registry], None]
) -> None:
    registry = registry_of(more)
    assert publish_from(more).version.version == 2
    hold(registry)
    for _ in range(2):  # every night
        done = publish_from(more)
        assert (done.version.version, done.candidate) == (2, True)
        assert "stays champion" in done.reason
    assert registry.resolve("beta").version == 1
    assert registry.resolve(f"beta@{CANDIDATE}").version == 2
    registry.hold("beta", "champion", "unpin")
    assert not publish_from(more).candidate
    assert registry.resolve("beta").version == 2
    registry.hold("beta", "champion", "pin")
    registry.hold("beta", "champion", "unpin")
    assert registry.rollback("beta", "champion") == 1, "pins are no steps that it goes back"


def test_a_version_keeps_which_drives_made_it(champion: Warehouse) -> None:
    registry = registry_of(champion)
    write(champion, "more", 48, adhesion=0.4)
    publish_from(champion, "adhesion < 0.5", force=True)
    assert models_trained_on(champion, ["good-3"]) == ["beta@1"]
    assert models_trained_on(champion, ["more-3", "unknown"]) == ["beta@2"]
    trained = [registry.trained_drives(registry.load("beta", item).manifest) for item in (1, 2)]
    assert [len(item.salted) for item in trained if item] == [48, 48]
    # The question of the first cohort, asked anew, would now have the other drives, too.
    assert forget(champion, ErasureSubject("drive", "more-3")).models == ("beta@2",)


def test_drives_that_are_gone_or_damaged_count_as_trained_on(champion: Warehouse) -> None:
    folder = Path(str(registry_of(champion).versions_of("beta").folder))
    (document,) = folder.glob("drives-*.bin")
    content = bytearray(document.read_bytes())
    assert len(content) == 48 * 8
    content[3] ^= 1
    document.write_bytes(content)
    assert models_trained_on(champion, ["unknown"]) == ["beta@1"]
    document.unlink()
    assert models_trained_on(champion, ["unknown"]) == ["beta@1"]


def test_nothing_about_a_drives_name_stands_in_what_is_kept(champion: Warehouse) -> None:
    for file in Path(str(champion.root / "models")).rglob("*"):
        assert file.is_dir() or b"good-" not in file.read_bytes()
