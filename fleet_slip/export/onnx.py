"""A program as an ONNX graph of one tick, in opset 17: inputs in SI units, state in and state out.

Everything up to the columns is computed in integers of 64 bits, so that the columns are those of
the warehouse. The dot product is in the float type that is asked for.

    inputs   signals (cars, signals) float      facts, numbers (cars, ...) int64, if there are any
             ring_I (cars, ticks) int64, sum_K and values_K (cars, 1) int64
    outputs  angle (cars, 1) float, NaN where there is none; each state as NAME_next

A ring has the oldest value first. A missing value of a ring, an unknown fact or number is
`UNKNOWN`, -2^31.
"""

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import Any, Literal

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from fleet_slip.columns.lowering import (
    GIVEN,
    POWERS,
    operands_of,
    operation_of,
    plain_of,
    size_of,
)
from fleet_slip.export.program import Program
from fleet_slip.models.registry import ModelVersion

# Nodes of an ONNX graph: how they are written, and what several of them compute together.


class Nodes:
    """The nodes of a graph as they are written, its constants, inputs and outputs."""

    def __init__(self) -> None:
        """Begin with no node."""
        self.nodes: list[Any] = []
        self.inputs: list[Any] = []
        self.outputs: list[Any] = []
        self.constants: list[Any] = []
        self._known: dict[tuple[str, bytes], str] = {}

    def do(self, operation: str, *inputs: str | int, out: str = "", **attributes: Any) -> str:
        """Add a node; whole numbers are constants. Return the name of what it computes."""
        names = [one if isinstance(one, str) else self.constant(one) for one in inputs]
        name = out or f"{operation.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operation, names, [name], **attributes))
        return name

    def constant(self, value: Any, dtype: Any = np.int64) -> str:
        """Return the name of a constant, which is written once."""
        array = np.asarray(value, dtype)
        key = (f"{array.dtype}{array.shape}", array.tobytes())
        if key not in self._known:
            self._known[key] = f"constant_{len(self._known)}"
            self.constants.append(numpy_helper.from_array(array, self._known[key]))
        return self._known[key]

    def nearest(self, value: str, divisor: str) -> str:
        """Return a quotient to the nearest, halves away from zero."""
        twice = self.do("Mul", self.do("Abs", value), 2)
        size = self.do("Div", self.do("Add", twice, divisor), self.do("Mul", divisor, 2))
        return self.signed(value, size)

    def signed(self, value: str, size: str | int) -> str:
        """Return a size with the sign of a value.

        Not by `Sign`: of vectors of int64, onnxruntime 1.31 takes it from the lower 32 bits.
        """
        negative = self.do("Less", value, 0)
        return self.do("Where", negative, self.do("Neg", size), size)

    def declare(self, name: str, width: int, kind: int = TensorProto.INT64) -> str:
        """Declare an input of shape (cars, width); return its name."""
        self.inputs.append(helper.make_tensor_value_info(name, kind, ["cars", width]))
        return name

    def declare_next(self, name: str, width: int) -> str:
        """Declare an output for a state after the tick; return its name."""
        declared = helper.make_tensor_value_info(f"{name}_next", TensorProto.INT64, ["cars", width])
        self.outputs.append(declared)
        return f"{name}_next"

    def part(self, name: str, first: int, last: int) -> str:
        """Return some columns of a tensor."""
        return self.do(
            "Slice", name, *(self.constant([one]) for one in (first, last)), self.constant([1])
        )


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
    largest = [size_of(program.ranges[place]) for place, _ in program.angle.terms]
    size = abs(intercept) + sum(abs(g) * n for g, n in zip(coefficients, largest, strict=True))
    roundoff = Fraction(1, 2 ** FLOAT_BITS[kind])
    return float(size * ((1 + roundoff) ** (len(coefficients) + 4) - 1))


def _radians(version: ModelVersion) -> list[Fraction]:
    """Return the intercept, and the coefficients of counts, in the unit of the angle."""
    exact = version.manifest.counts_model(version.catalog)
    unit = Fraction(version.catalog.signals[version.manifest.label.signal].scale)
    return [one * unit for one in (exact.intercept, *exact.coefficients)]


def _properties(version: ModelVersion, program: Program, kind: FloatName) -> dict[str, str]:
    return {
        "model": version.reference,
        "sha256": version.sha256,
        "drives_sha256": version.manifest.trained_on.drives_sha256,
        "signals": ",".join(one.column for one in program.signals),
        "facts": ",".join(one.field for one in program.facts),
        "numbers": ",".join(f"{one.name} in counts of {one.grain:f}" for one in program.numbers),
        "angle": f"{program.angle.column} in {program.angle.unit}",
        "error": f"{error_bound(version, program, kind):.3g} {program.angle.unit}",
    }


class _Writer(Nodes):
    """Writes the nodes of a program, of each step once: its value, and where it is there."""

    def __init__(self, program: Program, kind: FloatName) -> None:
        """Begin with no node."""
        super().__init__()
        self.program, self.kind = program, _KINDS[kind]
        self.dtype: Any = np.dtype(kind)
        self._roots = program.roots
        self._values: dict[int, str] = {}
        self._present: dict[int, str] = {}
        self._rings: dict[int, str] = {}
        self._slid: dict[tuple[int, ...], tuple[str, str]] = {}
        self._given: dict[str, str] = {}

    def write(self, exact: Sequence[Fraction]) -> None:
        """Write all; `exact` is the intercept and the coefficients in the unit of the angle."""
        places = [place for place, _ in self.program.angle.terms]
        program = self.program
        self._given["signal"] = self.declare("signals", len(program.signals), self.kind)
        for name, told in (("fact", program.facts), ("number", program.numbers)):
            if told:
                self._given[name] = self.declare(f"{name}s", len(told))
        values, there = [self._value(place) for place in places], self._there(*places)
        for number, place in enumerate(places):
            if self._is_constant(place):  # of no car: with a row for each, it can stand by others
                values[number] = self.do("Where", there, values[number], 0)
        self._angle(values, there, exact)

    def _is_constant(self, step: int) -> bool:
        """Whether the value of a step is the same wherever it is there."""
        name, of = operation_of(self.program.steps[step]), operands_of(self.program.steps[step])
        values = of[:1] if name in ("where", "at_least") else of
        return name == "constant" or (bool(of) and all(map(self._is_constant, values)))

    def _value(self, step: int) -> str:
        """Return the value of a step: any of its range where it is missing."""
        if step not in self._values:
            name, plain = operation_of(self.program.steps[step]), plain_of(self.program.steps[step])
            self._values[step] = self._computed(step, name, plain)
        return self._values[step]

    def _there(self, *steps: int) -> str:
        """Return whether all of some steps are there."""
        roots = dict.fromkeys(root for step in steps for root in self._roots[step])
        first, *rest = [self._root(one) for one in roots] or [self.constant([[True]], np.bool_)]
        for one in rest:
            first = self.do("And", first, one)
        return first

    def _root(self, step: int) -> str:
        """Return whether a step is there by itself."""
        if step not in self._present:
            name, plain = operation_of(self.program.steps[step]), plain_of(self.program.steps[step])
            if name in ("//", "nearest"):
                self._present[step] = self.do("Greater", self._value(plain[1]), 0)
            elif name == "at_least":
                both = (self._value(one) for one in plain)
                self._present[step] = self.do("GreaterOrEqual", *both)
            elif name == "else":
                self._present[step] = self.do("Or", *(self._there(one) for one in plain))
            else:
                self._value(step)
        return self._present[step]

    def _computed(self, step: int, name: str, plain: tuple[int, ...]) -> str:
        if name in ("constant", "where", "at_least"):
            return self.constant(plain[0]) if name == "constant" else self._value(plain[0])
        if name in GIVEN:
            return self._taken(step, name, plain[0])
        if name == "ago":
            length = self.program.rings[plain[0]]
            past = self.part(self._ring(plain[0]), length - plain[1], length - plain[1] + 1)
            there = self.do("Not", self.do("Equal", past, UNKNOWN))
            return self._taken_where(step, there, past)
        if name in ("sum", "values"):
            return self._slide(*plain)[name == "values"]
        values = [self._value(one) for one in plain]
        if name == "else":
            return self.do("Where", self._there(plain[0]), *values)
        if name in ("//", "nearest") and self.program.ranges[plain[1]][0] <= 0:
            values[1] = self.do("Max", values[1], 1)
        return _OPERATIONS[name](self, *values)

    def _taken(self, step: int, name: str, place: int) -> str:
        """Write what is given, which is missing beyond its range: a signal is rounded to counts."""
        given = self.part(self._given[name], place, place + 1)
        kind: Any = np.int64
        if name == "signal":
            kind = self.dtype
            scale = self.constant(float(self.program.signals[place].scale), kind)
            given = self.do("Round", self.do("Div", given, scale))
        least, most = (self.constant(n, kind) for n in self.program.given[name][place])
        inside = self.do("LessOrEqual", given, most)
        inside = self.do("And", inside, self.do("GreaterOrEqual", given, least))
        return self._taken_where(step, inside, given, kind)

    def _taken_where(self, step: int, there: str, given: str, kind: Any = np.int64) -> str:
        self._present[step] = there
        safe = self.do("Where", there, given, self.constant(0, kind))
        return safe if kind is np.int64 else self.do("Cast", safe, to=TensorProto.INT64)

    def _ring(self, of: int) -> str:
        """Return a ring with the value of this tick behind it."""
        if of not in self._rings:
            ticks = self.program.rings[of]
            ring = self.declare(f"ring_{of}", ticks)
            kept = self.do("Where", self._there(of), self._value(of), UNKNOWN)
            self._rings[of] = longer = self.do("Concat", ring, kept, axis=1)
            ends = [self.constant([one]) for one in (1, ticks + 1, 1)]
            self.do("Slice", longer, *ends, out=self.declare_next(f"ring_{of}", ticks))
        return self._rings[of]

    def _slide(self, *window: int) -> tuple[str, str]:
        """Return the sum and the number of the values of a window."""
        if window not in self._slid:
            of, ticks, most = window
            self._slid[window] = self._last(of, ticks) if ticks else self._ever(of, most)
        return self._slid[window]

    def _ever(self, of: int, most: int) -> tuple[str, str]:
        total, count = (self.declare(f"{one}_{of}_of_{most}", 1) for one in ("sum", "values"))
        takes = self.do("And", self._there(of), self.do("Less", count, most))
        more = self.do("Where", takes, self._value(of), 0)
        one_more = self.do("Cast", takes, to=TensorProto.INT64)
        return (
            self.do("Add", total, more, out=self.declare_next(total, 1)),
            self.do("Add", count, one_more, out=self.declare_next(count, 1)),
        )

    def _last(self, of: int, ticks: int) -> tuple[str, str]:
        length = self.program.rings[of] + 1
        values = self.part(self._ring(of), length - ticks, length)
        there = self.do("Not", self.do("Equal", values, UNKNOWN))
        axis = self.constant([1])
        total = self.do("ReduceSum", self.do("Where", there, values, 0), axis, keepdims=1)
        counted = self.do("Cast", there, to=TensorProto.INT64)
        return total, self.do("ReduceSum", counted, axis, keepdims=1)

    def _angle(self, terms: Sequence[str], there: str, exact: Sequence[Fraction]) -> None:
        intercept, *coefficients = (float(one) for one in exact)
        counts = self.do("Concat", *terms, axis=1)
        weights = self.constant([[one] for one in coefficients], self.dtype)
        total = self.do("MatMul", self.do("Cast", counts, to=self.kind), weights)
        total = self.do("Add", total, self.constant(intercept, self.dtype))
        nothing = self.constant(np.nan, self.dtype)
        self.do("Where", there, total, nothing, out="angle")
        self.outputs.insert(0, helper.make_tensor_value_info("angle", self.kind, ["cars", 1]))


def _sign(graph: Nodes, a: str) -> str:
    return graph.signed(a, graph.do("Min", graph.do("Abs", a), 1))


def _power(graph: Nodes, a: str, most: str) -> str:
    """Return one more than the sum of the powers of two times which `most` is below a value."""
    powers = graph.constant([[1 << bit for bit in range(POWERS)]])
    below = graph.do("Greater", a, graph.do("Mul", most, powers))
    some = graph.do("Mul", graph.do("Cast", below, to=TensorProto.INT64), powers)
    return graph.do("Add", graph.do("ReduceSum", some, graph.constant([1]), keepdims=1), 1)


def _node(name: str) -> Callable[..., str]:
    return lambda graph, *operands: graph.do(name, *operands)


_OPERATIONS: Mapping[str, Callable[..., str]] = {
    "+": _node("Add"),
    "-": _node("Sub"),
    "*": _node("Mul"),
    "min": lambda graph, a, b: graph.do("Where", graph.do("LessOrEqual", a, b), a, b),
    "max": lambda graph, a, b: graph.do("Where", graph.do("GreaterOrEqual", a, b), a, b),
    "power": _power,
    "negative": _node("Neg"),
    "abs": _node("Abs"),
    "sign": _sign,
    "//": lambda graph, a, b: graph.signed(a, graph.do("Div", graph.do("Abs", a), b)),
    "nearest": lambda graph, a, b: graph.nearest(a, b),
    "clip": lambda graph, a, b: graph.do("Max", graph.do("Min", a, b), graph.do("Neg", b)),
}
"""What computes an operation of the values that it works on.

No `Min` and `Max` of two vectors of int64, of which onnxruntime 1.31 compares the lower 32 bits.
"""
