"""A program as an ONNX graph of one tick, in opset 17: SI units and state in, angle and state out.

Everything up to the columns is computed in integers of 64 bits, so that the columns are those of
the warehouse. The dot product has the requested float type.

    inputs   signals (cars, signals) float      facts, numbers (cars, ...) int64, if there are any
             ring_I (cars, ticks) int64, sum_K, values_K and state_I (cars, 1) int64
    outputs  angle (cars, 1) float, NaN without an angle; each state as NAME_next

The oldest value of a ring is the first. A missing value of a ring, an unknown fact or number is
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
    size_of,
)
from fleet_slip.export.program import Program
from fleet_slip.models.registry import ModelVersion


class Nodes:
    """Nodes, constants, inputs and outputs of a graph."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.inputs: list[Any] = []
        self.outputs: list[Any] = []
        self.constants: list[Any] = []
        self._constant_names: dict[tuple[str, bytes], str] = {}

    def do(self, operation: str, *inputs: str | int, out: str = "", **attributes: Any) -> str:
        """Add a node; return the name of its result. Whole numbers become constants."""
        names = [item if isinstance(item, str) else self.constant(item) for item in inputs]
        name = out or f"{operation.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operation, names, [name], **attributes))
        return name

    def constant(self, value: Any, dtype: Any = np.int64) -> str:
        """Return the name of a constant; equal ones are written once."""
        array = np.asarray(value, dtype)
        key = (f"{array.dtype}{array.shape}", array.tobytes())
        if key not in self._constant_names:
            self._constant_names[key] = f"constant_{len(self._constant_names)}"
            self.constants.append(numpy_helper.from_array(array, self._constant_names[key]))
        return self._constant_names[key]

    def nearest(self, value: str, divisor: str) -> str:
        """Divide to the nearest integer, halves away from zero."""
        twice = self.do("Mul", self.do("Abs", value), 2)
        size = self.do("Div", self.do("Add", twice, divisor), self.do("Mul", divisor, 2))
        return self.signed(value, size)

    def signed(self, value: str, size: str | int) -> str:
        """Return a size with the sign of a value.

        `Sign` of onnxruntime 1.31 uses the lower 32 bits of vectors of int64 only.
        """
        negative = self.do("Less", value, 0)
        return self.do("Where", negative, self.do("Neg", size), size)

    def declare(self, name: str, width: int, kind: int = TensorProto.INT64) -> str:
        """Declare an input of shape (cars, width); return its name."""
        self.inputs.append(helper.make_tensor_value_info(name, kind, ["cars", width]))
        return name

    def declare_next(self, name: str, width: int) -> str:
        """Declare the output of a state after the tick; return its name."""
        declared = helper.make_tensor_value_info(f"{name}_next", TensorProto.INT64, ["cars", width])
        self.outputs.append(declared)
        return f"{name}_next"

    def columns(self, name: str, first: int, last: int) -> str:
        """Return some columns of a tensor."""
        ends = (self.constant([first]), self.constant([last]))
        return self.do("Slice", name, *ends, self.constant([1]))


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
    """Return a bound of the difference from the exact model, in the SI unit of the angle.

    With unit roundoff u and k terms, each product of a rounded coefficient and a rounded column is
    part of at most k + 1 additions. The bound is (1 + u)^(k + 4) - 1 times the sum of sizes.

    References
    ----------
    N. J. Higham, "Accuracy and Stability of Numerical Algorithms" (2002), section 3.1.
    """
    intercept, *coefficients = _radians(version)
    largest = [size_of(program.ranges[place]) for place, _ in program.angle.terms]
    size = abs(intercept) + sum(abs(g) * n for g, n in zip(coefficients, largest, strict=True))
    roundoff = Fraction(1, 2 ** FLOAT_BITS[kind])
    return float(size * ((1 + roundoff) ** (len(coefficients) + 4) - 1))


def _radians(version: ModelVersion) -> list[Fraction]:
    """Return the intercept, and the coefficients of counts, in the unit of the angle."""
    exact = version.manifest.estimate.counts_model(version.catalog)
    unit = Fraction(version.catalog.signals[version.manifest.label.signal].scale)
    return [value * unit for value in (exact.intercept, *exact.coefficients)]


def _properties(version: ModelVersion, program: Program, kind: FloatName) -> dict[str, str]:
    return {
        "model": version.reference,
        "sha256": version.sha256,
        "drives_sha256": version.manifest.trained_on.drives_sha256,
        "signals": ",".join(signal.column for signal in program.signals),
        "facts": ",".join(fact.field for fact in program.facts),
        "numbers": ",".join(f"{n.name} in counts of {n.grain:f}" for n in program.numbers),
        "angle": f"{program.angle.column} in {program.angle.unit}",
        "error": f"{error_bound(version, program, kind):.3g} {program.angle.unit}",
    }


class _Writer(Nodes):
    """Writes the value and the presence of each step of a program, once."""

    def __init__(self, program: Program, kind: FloatName) -> None:
        super().__init__()
        self.program, self.kind = program, _KINDS[kind]
        self.dtype: Any = np.dtype(kind)
        self._roots = program.roots
        self._values: dict[int, str] = {}
        self._present: dict[int, str] = {}
        self._rings: dict[int, str] = {}
        self._sums: dict[tuple[int, ...], tuple[str, str]] = {}
        self._input_names: dict[str, str] = {}

    def write(self, exact: Sequence[Fraction]) -> None:
        """Write the graph; `exact` has intercept and coefficients in the unit of the angle."""
        places = [place for place, _ in self.program.angle.terms]
        program = self.program
        self._input_names["signal"] = self.declare("signals", len(program.signals), self.kind)
        for name, properties in (("fact", program.facts), ("number", program.numbers)):
            if properties:
                self._input_names[name] = self.declare(f"{name}s", len(properties))
        values, present = [self._value(place) for place in places], self._is_present(*places)
        for i, place in enumerate(places):
            if self._is_constant(place):  # a scalar, which needs a row for each car
                values[i] = self.do("Where", present, values[i], 0)
        for step, following in program.states.items():
            name, value = self.declare_next(f"state_{step}", 1), self._value(following)
            self.do("Identity", value, out=name)
        self._angle(values, present, exact)

    def _is_constant(self, step: int) -> bool:
        """Return True if a step has the same value at all ticks at which it is not missing."""
        name, operands, _ = self.program.steps[step]
        values = operands[:1] if name in ("where", "at_least") else operands
        return name == "constant" or (bool(operands) and all(map(self._is_constant, values)))

    def _value(self, step: int) -> str:
        """Return the value of a step; any value of its range where it is missing."""
        if step not in self._values:
            name, operands, plain = self.program.steps[step]
            self._values[step] = self._computed(step, name, (*operands, *plain))
        return self._values[step]

    def _is_present(self, *steps: int) -> str:
        """Return the node that is true where none of these steps is missing."""
        roots = dict.fromkeys(root for step in steps for root in self._roots[step])
        nodes = [self._is_root_present(root) for root in roots]
        result = nodes[0] if nodes else self.constant([[True]], np.bool_)
        for node in nodes[1:]:
            result = self.do("And", result, node)
        return result

    def _is_root_present(self, step: int) -> str:
        """Return the node that is false where a step is missing by itself."""
        if step not in self._present:
            name, operands, _ = self.program.steps[step]
            if name in ("//", "nearest"):
                self._present[step] = self.do("Greater", self._value(operands[1]), 0)
            elif name == "at_least":
                self._present[step] = self.do("GreaterOrEqual", *map(self._value, operands))
            elif name == "else":
                self._present[step] = self.do("Or", *map(self._is_present, operands))
            else:
                self._value(step)
        return self._present[step]

    def _computed(  # noqa: PLR0911 - one for each kind of operation
        self, step: int, name: str, plain: tuple[int, ...]
    ) -> str:
        if name in ("constant", "where", "at_least"):
            return self.constant(plain[0]) if name == "constant" else self._value(plain[0])
        if name == "state":
            return self.declare(f"state_{step}", 1)
        if name == "shift":
            return self.nearest(self._value(plain[0]), self.constant(1 << plain[1]))
        if name in GIVEN:
            return self._input(step, name, plain[0])
        if name == "ago":
            length = self.program.rings[plain[0]]
            past = self.columns(self._ring(plain[0]), length - plain[1], length - plain[1] + 1)
            present = self.do("Not", self.do("Equal", past, UNKNOWN))
            return self._zero_where_missing(step, present, past)
        if name in ("sum", "values"):
            return self._sum(*plain)[name == "values"]
        values = [self._value(operand) for operand in plain]
        if name == "else":
            return self.do("Where", self._is_present(plain[0]), *values)
        if name in ("//", "nearest") and self.program.ranges[plain[1]][0] <= 0:
            values[1] = self.do("Max", values[1], 1)
        return _OPERATIONS[name](self, *values)

    def _input(self, step: int, name: str, place: int) -> str:
        """Write an input, which is missing out of range. Signals are rounded to counts."""
        value = self.columns(self._input_names[name], place, place + 1)
        kind: Any = np.int64
        if name == "signal":
            kind = self.dtype
            scale = self.constant(float(self.program.signals[place].scale), kind)
            value = self.do("Round", self.do("Div", value, scale))
        low, high = (self.constant(n, kind) for n in self.program.input_ranges[name][place])
        inside = self.do("LessOrEqual", value, high)
        inside = self.do("And", inside, self.do("GreaterOrEqual", value, low))
        return self._zero_where_missing(step, inside, value, kind)

    def _zero_where_missing(self, step: int, present: str, value: str, kind: Any = np.int64) -> str:
        self._present[step] = present
        safe = self.do("Where", present, value, self.constant(0, kind))
        return safe if kind is np.int64 else self.do("Cast", safe, to=TensorProto.INT64)

    def _ring(self, source: int) -> str:
        """Return a ring followed by the value of this tick."""
        if source not in self._rings:
            ticks = self.program.rings[source]
            ring = self.declare(f"ring_{source}", ticks)
            newest = self.do("Where", self._is_present(source), self._value(source), UNKNOWN)
            self._rings[source] = longer = self.do("Concat", ring, newest, axis=1)
            ends = [self.constant([i]) for i in (1, ticks + 1, 1)]
            self.do("Slice", longer, *ends, out=self.declare_next(f"ring_{source}", ticks))
        return self._rings[source]

    def _sum(self, source: int, ticks: int, limit: int) -> tuple[str, str]:
        """Return the sum of a window and its number of values."""
        window = (source, ticks, limit)
        if window in self._sums:
            return self._sums[window]
        if ticks:
            length = self.program.rings[source] + 1
            values = self.columns(self._ring(source), length - ticks, length)
            present = self.do("Not", self.do("Equal", values, UNKNOWN))
            axis = self.constant([1])
            total = self.do("ReduceSum", self.do("Where", present, values, 0), axis, keepdims=1)
            ones = self.do("Cast", present, to=TensorProto.INT64)
            count = self.do("ReduceSum", ones, axis, keepdims=1)
        else:
            before, earlier = (
                self.declare(f"{name}_{source}_of_{limit}", 1) for name in ("sum", "values")
            )
            adds = self.do("And", self._is_present(source), self.do("Less", earlier, limit))
            value = self.do("Where", adds, self._value(source), 0)
            one_more = self.do("Cast", adds, to=TensorProto.INT64)
            total = self.do("Add", before, value, out=self.declare_next(before, 1))
            count = self.do("Add", earlier, one_more, out=self.declare_next(earlier, 1))
        self._sums[window] = total, count
        return self._sums[window]

    def _angle(self, terms: Sequence[str], present: str, exact: Sequence[Fraction]) -> None:
        intercept, *coefficients = (float(value) for value in exact)
        counts = self.do("Concat", *terms, axis=1)
        weights = self.constant([[coefficient] for coefficient in coefficients], self.dtype)
        total = self.do("MatMul", self.do("Cast", counts, to=self.kind), weights)
        total = self.do("Add", total, self.constant(intercept, self.dtype))
        self.do("Where", present, total, self.constant(np.nan, self.dtype), out="angle")
        self.outputs.insert(0, helper.make_tensor_value_info("angle", self.kind, ["cars", 1]))


def _power(graph: Nodes, a: str, b: str) -> str:
    """Return 1 plus the sum of all powers of two p with b · p < a: the least p with a ≤ b · p."""
    powers = graph.constant([[1 << bit for bit in range(POWERS)]])
    below = graph.do("Greater", a, graph.do("Mul", b, powers))
    terms = graph.do("Mul", graph.do("Cast", below, to=TensorProto.INT64), powers)
    return graph.do("Add", graph.do("ReduceSum", terms, graph.constant([1]), keepdims=1), 1)


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
    "sign": lambda graph, a: graph.signed(a, graph.do("Min", graph.do("Abs", a), 1)),
    "//": lambda graph, a, b: graph.signed(a, graph.do("Div", graph.do("Abs", a), b)),
    "nearest": lambda graph, a, b: graph.nearest(a, b),
    "clip": lambda graph, a, b: graph.do("Max", graph.do("Min", a, b), graph.do("Neg", b)),
}
"""Nodes of operations on values.

`Min` and `Max` of onnxruntime 1.31 compare the lower 32 bits of two vectors of int64 only.
"""
