"""A program as an ONNX graph of one tick, in opset 17: inputs in SI units, state in and state out.

Everything up to the columns is computed in integers of 64 bits, so that the columns are those of
the warehouse. The dot product is in the float type that is asked for.

    inputs   signals (cars, signals) float      facts, numbers (cars, ...) int64, if there are any
             ring_I (cars, ticks) int64, sum_K and values_K (cars, 1) int64
    outputs  angle (cars, 1) float, NaN where there is none; each state as NAME_next

A ring has the oldest value first. A missing value of a ring, an unknown fact or number is
`UNKNOWN`, -2^31.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any, Literal

import numpy as np
import onnx
from onnx import TensorProto, helper

from fleet_slip.catalogue.arithmetic import Arithmetic
from fleet_slip.catalogue.columns import LARGEST_FACT, WEIGHT
from fleet_slip.catalogue.signals import COUNT_MAX, catalogue
from fleet_slip.export.c_columns import sum_key, summed
from fleet_slip.export.onnx_nodes import Nodes, Value
from fleet_slip.export.program import Factor, Gated, Numbered, Program, Source, Window
from fleet_slip.models.counts_model import counts_model
from fleet_slip.models.model_version import ModelVersion

OPSET, IR_VERSION = 17, 8
UNKNOWN = -(2**31)

FloatName = Literal["float32", "float64"]
FLOAT_BITS = {"float32": 24, "float64": 53}
_KINDS = {"float32": TensorProto.FLOAT, "float64": TensorProto.DOUBLE}


def onnx_model(version: ModelVersion, program: Program, kind: FloatName) -> bytes:
    """Return the graph of a version as the bytes of a file."""
    writer = _Writer(program, kind)
    writer.write(_radians(version))
    graph = helper.make_graph(
        writer.nodes,
        f"{program.angle.name}_{version.manifest.name}",
        writer.inputs,
        writer.outputs,
        writer.constants,
    )
    model = helper.make_model(
        graph,
        producer_name="fleet-slip",
        ir_version=IR_VERSION,
        opset_imports=[helper.make_opsetid("", OPSET)],
    )
    helper.set_model_props(model, _properties(version, program, kind))
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString(deterministic=True))


def error_bound(version: ModelVersion, program: Program, kind: FloatName) -> float:
    """Return how far the angle can be from the exact model, in its SI unit.

    With u the unit roundoff and k terms, each product of a rounded coefficient and a rounded column
    meets at most k + 1 additions: (1 + u)^(k + 4) - 1 times the sum of sizes (Higham 2002, 3.1).
    """
    intercept, *coefficients = _radians(version)
    largest = [program.columns[place].largest for place, _ in program.angle.terms]
    size = abs(intercept) + sum(abs(g) * n for g, n in zip(coefficients, largest, strict=True))
    roundoff = Fraction(1, 2 ** FLOAT_BITS[kind])
    return float(size * ((1 + roundoff) ** (len(coefficients) + 4) - 1))


def _radians(version: ModelVersion) -> list[Fraction]:
    """Return the intercept, and the coefficients of counts, in the unit of the angle."""
    exact = counts_model(version.manifest)
    unit = Fraction(catalogue()[version.manifest.label.signal].scale)
    return [one * unit for one in (exact.intercept, *exact.coefficients)]


def _properties(version: ModelVersion, program: Program, kind: FloatName) -> dict[str, str]:
    return {
        "model": version.reference,
        "sha256": version.sha256,
        "drives_sha256": version.manifest.trained_on.drives_sha256 or "",
        "signals": ",".join(one.column for one in program.signals),
        "facts": ",".join(one.field for one in program.facts),
        "numbers": ",".join(f"{one.name} in counts of {one.grain:f}" for one in program.numbers),
        "angle": f"{program.angle.column} in {program.angle.unit}",
        "error": f"{error_bound(version, program, kind):.3g} {program.angle.unit}",
    }


class _Writer(Nodes):
    """Writes the nodes of a program."""

    def __init__(self, program: Program, kind: FloatName) -> None:
        """Begin with no node."""
        super().__init__()
        self.program, self.kind = program, _KINDS[kind]
        self.dtype: Any = np.dtype(kind)

    def write(self, exact: Sequence[Fraction]) -> None:
        """Write all; `exact` is the intercept and the coefficients in the unit of the angle."""
        program = self.program
        signals = self._signals()
        facts = self._told("facts", [LARGEST_FACT] * len(program.facts))
        numbers = self._told("numbers", [COUNT_MAX] * len(program.numbers))
        sources = [self._source(one, signals) for one in program.sources]
        rings = [self._ring(place, one) for place, one in enumerate(sources)]
        sums = {
            key: self._sum(key, window, rings[window.source], sources[window.source])
            for key, (_, window) in summed(program).items()
        }
        columns: list[Value] = []
        for place, one in enumerate(program.columns):
            match one:
                case Window():
                    columns.append(self._window(place, one, sources, rings, sums))
                case Factor():
                    columns.append(self._factor(one, columns[one.of], facts[one.fact]))
                case Gated():
                    columns.append(self._gated(one, columns[one.of], columns[one.by]))
                case Numbered():
                    running = None if one.running is None else columns[one.running]
                    columns.append(
                        self._numbered(one, columns[one.of], numbers[one.number], running)
                    )
        self._angle([columns[place] for place, _ in program.angle.terms], exact)

    def _signals(self) -> dict[str, Value]:
        found = {}
        given = self.declare("signals", len(self.program.signals), self.kind)
        for place, one in enumerate(self.program.signals):
            physical = self.part(given, place, place + 1)
            scale = self.constant(float(one.scale), self.dtype)
            count = self.do("Round", self.do("Div", physical, scale))
            least, most = (self.constant(n, self.dtype) for n in (one.min_count, one.max_count))
            inside = self.do("LessOrEqual", count, most)
            inside = self.do("And", inside, self.do("GreaterOrEqual", count, least))
            zero = self.constant(0.0, self.dtype)
            safe = self.do("Where", inside, count, zero)
            found[one.name] = Value(self.do("Cast", safe, to=TensorProto.INT64), inside)
        return found

    def _told(self, name: str, largest: Sequence[int]) -> list[Value]:
        """Return what a car is told, unknown beyond the largest."""
        if not largest:
            return []
        given = self.declare(name, len(largest))
        found = []
        for place, most in enumerate(largest):
            value = self.part(given, place, place + 1)
            known = self.do("LessOrEqual", self.do("Abs", value), most)
            found.append(self.where(known, value))
        return found

    def _source(self, one: Source, signals: Mapping[str, Value]) -> Value:
        if one.arithmetic is None:
            return signals[one.name]
        there = self.all_there([signals[name] for name in one.arithmetic.inputs])
        value, there = self._feature(one.arithmetic, signals, there)
        return self.where(there, self.clip(value, one.limit))

    def _feature(
        self, arithmetic: Arithmetic, signals: Mapping[str, Value], there: str
    ) -> tuple[str, str]:
        found: list[str] = []
        for number, step in enumerate(arithmetic.steps):
            operands = [found[i] for i in step.operands]
            if step.name:
                found.append(signals[step.name].value)
            elif not step.function:
                found.append(self.constant(step.value))
            elif step.function == "//":
                divisor = operands[1]
                there = self.do("And", there, self.do("Greater", divisor, 0))
                size = self.do("Div", self.do("Abs", operands[0]), self.do("Max", divisor, 1))
                found.append(self.signed(operands[0], size))
            elif step.function == "sign":
                one_or_zero = self.do("Min", self.do("Abs", operands[0]), 1)
                found.append(self.signed(operands[0], one_or_zero))
            else:
                found.append(self.do(_OPERATIONS[step.function], *operands))
            if number == arithmetic.guard:
                enough = self.do("GreaterOrEqual", found[-1], arithmetic.at_least)
                there = self.do("And", there, enough)
        return found[-1], there

    def _ring(self, place: int, now: Value) -> str:
        """Return a ring with the value of this tick behind it; the empty text without one."""
        ticks = self.program.sources[place].ticks
        if not ticks:
            return ""
        ring = self.declare(f"ring_{place}", ticks)
        kept = self.do("Where", now.there, now.value, UNKNOWN)
        longer = self.do("Concat", ring, kept, axis=1)
        last = [self.constant([one]) for one in (1, ticks + 1)]
        self.do(
            "Slice",
            longer,
            *last,
            self.constant([1]),
            out=self.declare_next(f"ring_{place}", ticks),
        )
        return longer

    def _sum(self, key: str, one: Window, ring: str, now: Value) -> tuple[str, str]:
        """Return the sum and the number of the values of a window."""
        if one.over == "running_mean":
            total, count = self.declare(f"sum_{key}", 1), self.declare(f"values_{key}", 1)
            takes = self.do("And", now.there, self.do("Less", count, one.most_values))
            more = self.do("Where", takes, now.value, 0)
            one_more = self.do("Cast", takes, to=TensorProto.INT64)
            return (
                self.do("Add", total, more, out=self.declare_next(total, 1)),
                self.do("Add", count, one_more, out=self.declare_next(count, 1)),
            )
        length = self.program.sources[one.source].ticks + 1
        values = self.part(ring, length - one.ticks, length)
        there = self.do("Not", self.do("Equal", values, UNKNOWN))
        axis = self.constant([1])
        total = self.do("ReduceSum", self.do("Where", there, values, 0), axis, keepdims=1)
        counted = self.do("Cast", there, to=TensorProto.INT64)
        return total, self.do("ReduceSum", counted, axis, keepdims=1)

    def _window(
        self,
        place: int,
        one: Window,
        sources: Sequence[Value],
        rings: Sequence[str],
        sums: Mapping[str, tuple[str, str]],
    ) -> Value:
        now = sources[one.source]
        total, divisor = now.value, self.constant(one.denominator)
        if one.over == "lag":
            at = self.program.sources[one.source].ticks - one.ticks
            past = self.part(rings[one.source], at, at + 1)
            now = self.where(self.do("Not", self.do("Equal", past, UNKNOWN)), past)
            total = now.value
        elif one.over is not None:
            total, count = sums[sum_key(place, one)]
            if one.over != "sum":
                divisor = self.do("Mul", divisor, self.do("Max", count, 1))
        quotient = self.nearest(total, one.numerator, divisor)
        return self.where(now.there, self.clip(quotient, one.limit))

    def _factor(self, one: Factor, of: Value, fact: Value) -> Value:
        product = self.do("Mul", of.value, self.do("Sub", fact.value, one.less))
        quotient = self.nearest(product, one.numerator, one.denominator)
        return self.where(self.all_there([of, fact]), self.clip(quotient, one.limit))

    def _gated(self, one: Gated, of: Value, by: Value) -> Value:
        rises = self.do("Mul", self.do("Max", self.do("Sub", by.value, one.low), 0), WEIGHT)
        weight = self.do("Min", self.do("Div", rises, one.peak - one.low), WEIGHT)
        if one.high is not None:
            beyond = self.do("Max", self.do("Sub", by.value, one.peak), 0)
            falls = self.do("Div", self.do("Mul", beyond, WEIGHT), one.high - one.peak)
            weight = self.do("Min", weight, self.do("Max", self.do("Sub", WEIGHT, falls), 0))
        quotient = self.nearest(self.do("Mul", of.value, weight), 1, WEIGHT)
        return self.where(self.all_there([of, by]), quotient)

    def _numbered(self, one: Numbered, of: Value, number: Value, running: Value | None) -> Value:
        stand_in, there = self.constant(0), of.there
        if running is not None:
            stand_in = running.value
            either = self.do("Or", number.there, running.there)
            there = self.do("And", there, either)
        less = self.do("Sub", number.value, one.less)
        factor = self.do("Where", number.there, less, stand_in)
        value = factor if one.alone else self.do("Mul", of.value, factor)
        return self.where(there, value)

    def _angle(self, terms: Sequence[Value], exact: Sequence[Fraction]) -> None:
        intercept, *coefficients = (float(one) for one in exact)
        counts = self.do("Concat", *(one.value for one in terms), axis=1)
        weights = self.constant([[one] for one in coefficients], self.dtype)
        total = self.do("MatMul", self.do("Cast", counts, to=self.kind), weights)
        total = self.do("Add", total, self.constant(intercept, self.dtype))
        nothing = self.constant(np.nan, self.dtype)
        self.do("Where", self.all_there(terms), total, nothing, out="angle")
        self.outputs.insert(0, helper.make_tensor_value_info("angle", self.kind, ["cars", 1]))


_OPERATIONS = {
    "+": "Add",
    "-": "Sub",
    "*": "Mul",
    "negative": "Neg",
    "abs": "Abs",
}
