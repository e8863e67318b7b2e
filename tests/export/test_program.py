"""Programs of published models compute what `score` computes, by an implementation of their own."""

from fractions import Fraction

import numpy as np
import pytest

from fleet_slip.base import canonical_json, sha256_of
from fleet_slip.catalogue.definitions import Combination, Definition
from fleet_slip.columns.operations import most_values
from fleet_slip.errors import QuestionError
from fleet_slip.export.compile import compile_program, make_checks
from fleet_slip.export.files import program_content
from tests.export import plain
from tests.export.models import DEFINITIONS, LEARNING, MODELS, model_of


def test_what_divides_by_a_constant_below_zero_has_no_program(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(DEFINITIONS, "by_minus_3", Definition(of="x", sql="ay // (-(3))"))
    with pytest.raises(QuestionError, match="not positive"):
        compile_program(model_of({"by_minus_3": Fraction(1, 7)}))


def test_every_kind_of_column_has_an_angle_in_the_checks() -> None:
    """Else the checks that travel with a program would check nothing of it."""
    for name in (*DEFINITIONS, *LEARNING):
        manifest = model_of({name: Fraction(1, 3)})
        program = compile_program(manifest)
        checks = make_checks(manifest, program)
        angles = {angle for check in checks for angle in check.angles}
        assert (None in angles) == (name not in ("slope", "one_below")), name  # always there
        assert len(angles) > (2 if name == "tyres" else 5), name
        for check in checks:
            content = program_content(program)
            facts, numbers = list(check.facts), list(check.numbers)
            assert plain.angles(content, facts, numbers, list(check.samples)) == list(check.angles)


def test_steps_that_several_columns_are_made_of_stand_once() -> None:
    third = Fraction(1, 3)
    content = program_content(
        compile_program(model_of({"mean_5": third, "below": third, "ay": third}))
    )
    steps = [tuple(one) for one in content["steps"]]
    assert len(steps) == len({*steps})
    assert [one for one in steps if one[0] == "signal"] == [("signal", 0), ("signal", 1)]
    assert [one[2] for one in steps if one[0] == "sum"] == [5, 3, 4]
    before = {"signal": 0, "fact": 0, "number": 0, "constant": 0, "ago": 1, "sum": 1, "values": 1}
    for place, (operation, *operands) in enumerate(steps):
        assert all(one < place for one in operands[: before.get(str(operation), 2)])


def test_a_running_mean_takes_no_more_than_its_most_values() -> None:
    """5 of ay's counts, then more: with a most of 2, they are the mean of the first two."""
    content = program_content(compile_program(model_of({"ever": Fraction(1, 1000)})))
    for step in content["steps"]:
        if step[0] in {"sum", "values"}:
            step[3] = 2
    first = plain.angles(content, [], [], [[5], [7], [None], [90]])
    assert first[1] == first[3] != first[0]
    assert first[2] is None


@pytest.mark.parametrize("sign", [1, -1])
def test_what_needs_more_than_63_bits_has_no_program(
    monkeypatch: pytest.MonkeyPatch, sign: int
) -> None:
    """20 bits times 2^43 have 62, which rounding doubles: computed exactly, by the kernel, too."""
    column = Definition(of="ay", over="sum", ticks=9, ratio=Fraction(16), bits=20)
    for times in (2**43, 2**44):
        made = Combination(terms=((sign * times + 1, column),), divisor=2**40)
        monkeypatch.setitem(LEARNING, "large", Definition(of="large", made=made, bits=20))
        manifest = model_of({"large": Fraction(1, 7)})
        if times > 2**43:
            with pytest.raises(QuestionError, match="63 bits"):
                compile_program(manifest)
            continue
        program = compile_program(manifest)
        for check in make_checks(manifest, program):
            samples = list(check.samples)
            assert plain.angles(program_content(program), [], [], samples) == list(check.angles)


def test_a_running_mean_ends_before_its_sum_overflows() -> None:
    widest = Definition(
        of="fast", sql="ay", of_bits=20, over="running_mean", ratio=Fraction(2**14), bits=20
    )
    twice, most = 2 * (2**19 - 1) * 2**14, most_values(widest)
    assert (twice + 1) * most < 2**63 <= (twice + 1) * (most + 1)
    assert most > 2**28


def test_a_feature_defined_in_two_ways_is_refused() -> None:
    manifest = model_of({"change_mean": Fraction(1), "heavy": Fraction(1)})
    other = Definition(of="change", sql="ay", of_bits=18, over="mean", ticks=2)
    term = manifest.terms[1].model_copy(update={"definition": other})
    with pytest.raises(QuestionError, match="two ways"):
        compile_program(manifest.model_copy(update={"terms": (manifest.terms[0], term)}))


def test_the_angle_is_rounded_halves_up() -> None:
    """0.00005 rad for each of ay's counts, 0.001 m/s^2: 5 counts of the angle; halves of 1/2."""
    program = compile_program(model_of({"ay": Fraction(1, 200)}))
    assert program.angle.bits > 40
    assert np.isclose(program.angle.terms[0][1] / 2**program.angle.bits, 0.5)
    found = plain.angles(program_content(program), [], [], [[-3], [-1], [0], [1], [3]])
    assert found == [-1, 0, 0, 1, 2]


@pytest.mark.parametrize(
    ("name", "sha256"), [("every_kind", "0d2839d120079dea"), ("features", "eab847943463cf02")]
)
def test_a_version_exported_again_has_the_same_steps_in_the_same_order(
    name: str, sha256: str
) -> None:
    """Of programs of version 0.2.0: whoever compares two exports of a version finds no change."""
    steps = [list(step) for step in compile_program(model_of(MODELS[name])).steps]
    assert sha256_of(canonical_json(steps)).startswith(sha256)
