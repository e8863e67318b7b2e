"""Nodes of an ONNX graph: how they are written, and what several of them compute together."""

from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper


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
