"""One published version of a model, which estimates angles from data frames."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol, overload

from fleet_slip.models.manifest import Manifest
from fleet_slip.pages.notebook_table import notebook_table

if TYPE_CHECKING:
    import polars as pl
    from numpy import float64
    from numpy.typing import ArrayLike, NDArray

    from fleet_slip.models.estimates.predictor import Predictor


class ArrowStream(Protocol):
    """A table of Arrow, or of a library that hands its tables over as Arrow."""

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object:
        """Return the table's batches."""


class PandasFrame(Protocol):
    """A data frame of pandas, which need not be installed."""

    @property
    def iloc(self) -> Any:
        """Rows by position."""


@dataclass(frozen=True)
class ModelVersion:
    """A manifest with its number and verified checksum."""

    version: int
    manifest: Manifest
    sha256: str

    def __repr__(self) -> str:
        figures = self.manifest.cross_validation
        return (
            f"<{type(self).__name__} {self.reference}: {len(self.manifest.terms)} signals, RMSE "
            f"{figures.rmse_deg:.4f} deg, correlation {figures.correlation:.4f}>"
        )

    def _repr_html_(self) -> str:
        terms = self.manifest.terms
        rows = [[term.column, term.unit, f"{term.coefficient:.6g}"] for term in terms]
        rows.append(["intercept", self.manifest.label.unit, f"{self.manifest.intercept:.6g}"])
        sizes = [*(term.coefficient * float(term.scale) for term in terms), 0.0]
        return notebook_table(repr(self)[1:-1], ["signal", "unit", "coefficient"], rows, sizes)

    @property
    def reference(self) -> str:
        """The version as it is named on the command line: `NAME@VERSION`."""
        return f"{self.manifest.name}@{self.version}"

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns in SI units that `predict` needs, named as in the view `log`."""
        return self.manifest.columns

    @overload
    def predict(self, frame: "pl.DataFrame") -> "pl.Series": ...
    @overload
    def predict(
        self, frame: "Mapping[str, ArrayLike | Sequence[float | None]]"
    ) -> "NDArray[float64]": ...
    @overload
    def predict(self, frame: ArrowStream | PandasFrame) -> Any: ...
    def predict(self, frame: Any) -> Any:
        """Estimate the side-slip angle in rad for each row of a frame.

        The frame has the columns of `columns` in SI units, as the view `log` has them; others are
        left alone. A model with features rounds the signals that they are made of to counts, half
        to even, and clips them to their valid range, as the sensors do. On the rows of the logs the
        angles have the bits that `score` computes.

        | frame | returned, one float64 for each row | no angle |
        | --- | --- | --- |
        | `polars.DataFrame` | `polars.Series` | null |
        | `pandas.DataFrame` | `pandas.Series` with its index | NaN |
        | `pyarrow.RecordBatch` | `pyarrow.Array` | null |
        | `pyarrow.Table`, a DuckDB relation, any Arrow stream | `pyarrow.ChunkedArray` | null |
        | mapping of names to arrays of shape (rows,) | `numpy.ndarray` of shape (rows,) | NaN |

        A model that looks back does so within a drive: by the columns `drive_id` and `tick` or
        `time_s`, if the frame has them; else its rows are the ticks of one drive, in their order.

        There is no angle where an input is null or NaN, or a feature has no value, such as a
        curvature at standstill.

        Raises `InputError` for a column that is missing (it says what is there), is there twice, is
        not of numbers, has infinite ones, or differs from the others in length.
        """
        from fleet_slip.models.estimates.predict import predict  # noqa: PLC0415 - DuckDB, not for show

        return predict(self.manifest, frame, self._predictor if self.manifest.definitions else None)

    @cached_property
    def _predictor(self) -> "Predictor":
        from fleet_slip.models.estimates.predictor import Predictor  # noqa: PLC0415 - numba, not for show

        return Predictor.of(self.manifest)
