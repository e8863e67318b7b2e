"""Model versions and aliases: numbered, immutable, verified, and safe with many writers."""

import json
import multiprocessing
from collections.abc import Callable, Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from fleet_slip.errors import QuestionError, RefusedError, StorageError
from fleet_slip.models.manifest import MAX_DIGITS, ExactFraction, TrainedDrives
from fleet_slip.models.registry import CHAMPION, AliasHistory, Registry
from fleet_slip.storage.documents import DocumentFolder
from fleet_slip.storage.local import LocalFolder
from tests.support.catalog import CATALOG
from tests.support.commands import PATIENCE_S
from tests.support.manifests import manifest, publish

PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(["fleet_slip.api.fleet"])  # once, for all that are forked


def call_at_once(function: Callable[..., object], arguments: Iterable[tuple[Any, ...]]) -> None:
    """Call a function with each of the arguments; an `AssertionError` if one fails or hangs."""
    processes = [
        PROCESSES.Process(target=function, args=values, daemon=True) for values in arguments
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join(PATIENCE_S)
    codes = [process.exitcode for process in processes]
    for process in processes:
        process.kill()
    assert codes == [0] * len(processes), codes


def test_versions_are_consecutive_and_the_latest_published_is_champion(tmp_path: Path) -> None:
    registry = Registry(LocalFolder(tmp_path), CATALOG)
    for number in (1, 2, 3):
        assert publish(registry, manifest(Fraction(number))).version == number
    assert registry.versions("sideslip") == [1, 2, 3]
    assert registry.resolve("sideslip").version == 3
    assert registry.resolve("sideslip@2").manifest.terms[0].coefficient == 2.0
    assert registry.resolve(f"sideslip@{CHAMPION}").reference == "sideslip@3"


def test_publishing_what_an_interrupted_run_left_uses_it(tmp_path: Path) -> None:
    registry = Registry(LocalFolder(tmp_path), CATALOG)
    DocumentFolder(LocalFolder(tmp_path), "models/sideslip/versions").append(
        manifest().model_dump(mode="json")
    )
    assert registry.champion("sideslip") is None
    assert publish(registry, manifest()).version == 1
    assert registry.versions("sideslip") == [1]


@pytest.mark.parametrize("change", ["coefficient", "sha256", "truncated"])
def test_a_changed_version_is_refused(tmp_path: Path, change: str) -> None:
    publish(Registry(LocalFolder(tmp_path), CATALOG), manifest())
    file = tmp_path / "models" / "sideslip" / "versions" / "1.json"
    envelope = json.loads(file.read_text())
    if change == "coefficient":
        envelope["content"]["terms"][0]["coefficient"] = 0.5
    elif change == "sha256":
        envelope["sha256"] = "0" * 64
    file.write_text(json.dumps(envelope)[: 40 if change == "truncated" else None])
    with pytest.raises(StorageError, match=r"1\.json"):
        Registry(LocalFolder(tmp_path), CATALOG).load("sideslip", 1)


def test_aliases_move_and_go_back(tmp_path: Path) -> None:
    registry = Registry(LocalFolder(tmp_path), CATALOG)
    for number in (1, 2, 3):
        publish(registry, manifest(Fraction(number)))
    registry.promote("sideslip", 1, CHAMPION)
    registry.promote("sideslip", 2, "shadow")
    history = registry.history("sideslip")
    assert history.aliases() == {CHAMPION: 1, "shadow": 2}
    assert [history.pointed_at(alias) for alias in (CHAMPION, "shadow", "unknown")] == [1, 2, None]
    rows = registry.as_table().to_pylist()
    assert [row["aliases"] for row in rows] == ["champion", "shadow", ""]
    assert [row["published_at"] for row in rows] == sorted(row["published_at"] for row in rows)
    assert [registry.rollback("sideslip", CHAMPION) for _ in range(3)] == [3, 2, 1]
    with pytest.raises(RefusedError, match="never pointed at another version"):
        registry.rollback("sideslip", CHAMPION)
    commands = [move.command for move in registry.history("sideslip").moves()]
    assert commands == ["publish"] * 3 + ["promote"] * 2 + ["rollback"] * 3


def test_unknown_names_versions_and_aliases_say_what_there_is(tmp_path: Path) -> None:
    registry = Registry(LocalFolder(tmp_path), CATALOG)
    with pytest.raises(QuestionError, match=r"no model is called 'x'.*publish one with"):
        registry.resolve("x")
    publish(registry, manifest())
    with pytest.raises(QuestionError, match=r"It has: 1\."):
        registry.resolve("sideslip@7")
    with pytest.raises(QuestionError, match=r"It has: 1, champion\."):
        registry.resolve("sideslip@best")
    with pytest.raises(QuestionError, match="no model is called"):
        registry.resolve("../../etc@1")


def _publish_ten(path: Path, writer: int) -> None:
    for number in range(10):
        publish(Registry(LocalFolder(path), CATALOG), manifest(Fraction(writer * 100 + number, 7)))


def test_writers_at_once_never_share_a_number_or_lose_a_version(tmp_path: Path) -> None:
    call_at_once(_publish_ten, [(tmp_path, writer) for writer in range(4)])
    registry = Registry(LocalFolder(tmp_path), CATALOG)
    numbers = registry.versions("sideslip")
    assert numbers == list(range(1, 41))
    published = {registry.load("sideslip", n).manifest.terms[0].coefficient_exact for n in numbers}
    assert len(published) == 40
    assert len(registry.history("sideslip").moves()) == 40


def _publish_the_same(path: Path, logs_version: int, barrier: Any) -> None:
    trained_on = manifest().trained_on.model_copy(update={"logs_version": logs_version})
    for model in range(20):
        barrier.wait()
        same = manifest(name=f"m{model}").model_copy(update={"trained_on": trained_on})
        publish(Registry(LocalFolder(path), CATALOG), same)


def test_writers_at_once_publish_the_same_estimator_once(tmp_path: Path) -> None:
    barrier = PROCESSES.Barrier(3, timeout=PATIENCE_S)
    call_at_once(_publish_the_same, [(tmp_path, version, barrier) for version in range(3)])
    registry = Registry(LocalFolder(tmp_path), CATALOG)
    for model in range(20):
        assert registry.versions(f"m{model}") == [1]
        moves = registry.history(f"m{model}").moves()
        assert [(move.alias, move.version) for move in moves] == [(CHAMPION, 1)]


def test_a_decision_about_another_champion_is_repeated(tmp_path: Path) -> None:
    registry = Registry(LocalFolder(tmp_path), CATALOG)
    history = registry.history("sideslip")
    challenger = registry.add(manifest(Fraction(2)), b"")
    seen: list[int | None] = []

    def decision(newest_move: int) -> bool | None:
        seen.append(history.pointed_at(CHAMPION))
        if len(seen) == 1:
            publish(registry, manifest(Fraction(1)))  # another process, in between
        number = challenger.version
        return history.move(CHAMPION, number, "publish", after=newest_move) or None

    history.decide(decision)
    assert seen == [None, 2]
    assert [move.version for move in history.moves()] == [2, 1]


def test_two_who_go_back_at_once_go_back_two_versions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    registry = Registry(LocalFolder(tmp_path), CATALOG)
    for number in (1, 2, 3):
        publish(registry, manifest(Fraction(number)))

    def slow_move(history: AliasHistory, *arguments: Any, after: int) -> bool:
        monkeypatch.setattr(AliasHistory, "move", move)
        assert registry.rollback("sideslip", CHAMPION) == 2  # another process, in between
        return move(history, *arguments, after=after)

    move = AliasHistory.move
    monkeypatch.setattr(AliasHistory, "move", slow_move)
    assert registry.rollback("sideslip", CHAMPION) == 1
    assert registry.history("sideslip").pointed_at(CHAMPION) == 1
    with pytest.raises(RefusedError, match="never pointed at another version"):
        registry.rollback("sideslip", CHAMPION)


FRACTIONS: TypeAdapter[Fraction] = TypeAdapter(ExactFraction)


@given(st.fractions(), st.sampled_from([0, 3990, 4000, 4400, 20000]))
def test_a_fraction_is_the_same_again(value: Fraction, digits: int) -> None:
    for fraction in (value * 10**digits, value / 10**digits - 1):
        text = FRACTIONS.dump_python(fraction)
        assert FRACTIONS.validate_python(text) == fraction


def test_decimal_numbers_stay_decimal() -> None:
    assert FRACTIONS.dump_python(Fraction(-3, 4)) == "-3/4"
    largest = 10**MAX_DIGITS - 1
    assert FRACTIONS.dump_python(Fraction(largest)) == f"{largest}/1"
    assert FRACTIONS.dump_python(-Fraction(largest + 1)).startswith("-0x")


@pytest.mark.parametrize("text", ["0x3/4", "3/0x4", "0x/0x1", "0x1/0x0", "1/0", "0X1/0x1", "1"])
def test_other_text_is_no_fraction(text: str) -> None:
    with pytest.raises(ValidationError):
        FRACTIONS.validate_python(text)


def test_hashes_of_drives_are_those_of_versions_of_before() -> None:
    """Computed by the release in which they came."""
    drives = np.array([1, 2], dtype=np.uint64)
    expected = [10430483359262113544, 11180994063705713938]
    trained = TrainedDrives.from_hashes("year", drives)
    assert trained.salted.tolist() == expected
    assert trained.content == b"".join(number.to_bytes(8, "big") for number in expected)
    assert TrainedDrives.from_content("year", trained.content).among(drives).all()
    assert not len(TrainedDrives.from_hashes("year", drives[:0]).salted)
    assert TrainedDrives.from_hashes("other", drives).salted.tolist() != expected
