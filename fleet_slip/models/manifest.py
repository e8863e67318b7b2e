"""Manifest of a model version: terms, figures, training data and selection, validated.

A manifest may come from anywhere: texts and numbers are bounded, and SQL in it is arithmetic only.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from hashlib import sha256
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    AliasChoices,
    ConfigDict,
    Field,
    FiniteFloat,
    PlainSerializer,
    PlainValidator,
    SerializerFunctionWrapHandler,
    TypeAdapter,
    ValidationInfo,
    model_serializer,
    model_validator,
)

from fleet_slip.base import pluralize
from fleet_slip.catalog.catalog import Catalog
from fleet_slip.catalog.definitions import (
    Blend,
    Combination,
    Definition,
    Made,
    integer_arithmetic,
    plain_column,
)
from fleet_slip.catalog.signals import IDENTIFIER_PATTERN, Identifier, SignalCatalog
from fleet_slip.config import Config
from fleet_slip.errors import RefusedError, UsageError
from fleet_slip.vehicle.parameters import VehicleMeasures

if TYPE_CHECKING:
    from fleet_slip.arrays import BoolArray, Hashes
    from fleet_slip.regression.least_squares import LinearModel

MAX_DIGITS = 4000
"""Maximum number of decimal digits of a number in decimal: Python refuses longer texts."""

_FRACTION = re.compile(
    r"(-?[0-9]{1,4000})/([0-9]{1,4000})|(-?0x[0-9a-f]{1,30000})/(0x[0-9a-f]{1,30000})"
)
"""In decimal, or in hexadecimal: models of hundreds of inputs need it."""


def _exact_fraction(value: Any) -> Fraction:
    """Return a fraction, also from its text "3/4". Raises `ValueError` for anything else."""
    if isinstance(value, Fraction):
        return value
    if isinstance(value, str) and (match := _FRACTION.fullmatch(value)):
        numerator, denominator = (int(number, 0) for number in match.groups() if number)
        if not denominator:
            raise ValueError("is divided by zero")
        return Fraction(numerator, denominator)
    raise ValueError("is not a fraction such as 3/4")


def _fraction_text(value: Fraction) -> str:
    """Return the text of a fraction, such as "3/4"; "0x3/0x4" if it were too long in decimal."""
    numerator, denominator = value.numerator, value.denominator
    if max(abs(numerator), denominator) < 10**MAX_DIGITS:
        return f"{numerator}/{denominator}"
    return f"{numerator:#x}/{denominator:#x}"


ExactFraction = Annotated[
    Fraction, PlainValidator(_exact_fraction), PlainSerializer(_fraction_text)
]

Scale = Annotated[Decimal, Field(ge=Decimal("1e-12"), le=Decimal("1e12"), allow_inf_nan=False)]

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]

Count = Annotated[int, Field(ge=0, lt=2**63)]

NotNegative = Annotated[FiniteFloat, Field(ge=0)]

Correlation = Annotated[FiniteFloat, Field(ge=-1 - 1e-9, le=1 + 1e-9)]
"""A correlation may exceed 1 by a rounding error."""


_OPTIONAL = Field(exclude_if=lambda value: value is None)
"""Omits None, so that manifests of earlier releases keep their content."""


def _require_rounded(value: float, exact: Fraction) -> None:
    """Raise `ValueError` if a number is not its exact fraction, rounded once."""
    try:
        rounded = float(exact)
    except OverflowError:
        rounded = math.inf
    if value != rounded:
        raise ValueError(f"says {value!r}, but its exact fraction is {rounded!r}")


class ModelTerm(Config):
    """One signal of a model: `label = intercept + sum(coefficient * signal)`, in SI units.

    A feature's `sql` gives its count, clipped to +-32767, from counts of signals; `scale` times it
    is the physical value. Columns over time, and features of more than 16 bits, have a `definition`
    and the `signal_scales` at publication instead.
    """

    signal: Identifier
    column: Identifier
    unit: str
    scale: Scale
    sql: Annotated[str, AfterValidator(integer_arithmetic)] = ""
    definition: Annotated[Definition | None, _OPTIONAL] = None
    signal_scales: Annotated[dict[Identifier, Scale] | None, _OPTIONAL] = None
    coefficient: FiniteFloat
    coefficient_exact: ExactFraction

    @model_validator(mode="after")
    def _agrees(self) -> "ModelTerm":
        if self.sql and self.definition:
            raise ValueError("a term has sql or a definition, not both")
        _require_rounded(self.coefficient, self.coefficient_exact)
        return self

    @property
    def logged(self) -> bool:
        """True if it is a logged signal, not a computed one."""
        return not self.sql and self.definition is None

    @property
    def alone(self) -> bool:
        """True if it is a calibration parameter of the car, constant in time."""
        number = self.definition.number if self.definition else None
        return number is not None and number.alone

    @property
    def scale_exact(self) -> Fraction:
        """Physical value of one count, exactly."""
        return Fraction(self.scale)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Logged signals that it is computed from: itself, or those in its SQL."""
        return (self.definition or plain_column(self.signal, self.sql)).signals


class ModelLabel(Config):
    """The quantity that a model estimates."""

    signal: Identifier
    column: Identifier
    unit: str
    scale: Scale


class CrossValidated(Config):
    """Pooled cross-validated figures of a model, and how the folds were made."""

    folds_by: str
    folds: Count
    correlation: Correlation
    correlation_standard_error: NotNegative
    rmse_deg: NotNegative
    error_mean_deg: FiniteFloat
    error_std_deg: NotNegative
    condition_number: NotNegative
    label_noise_deg: Annotated[NotNegative | None, _OPTIONAL] = None
    """White noise of the label, a part of all errors; None if unknown."""

    @property
    def beyond_label_noise_deg(self) -> float:
        """The RMSE without the label's noise."""
        return math.sqrt(max(self.rmse_deg**2 - (self.label_noise_deg or 0.0) ** 2, 0.0))


class TrainedOn(Config):
    """Training data of a model; `drives_without_log` are drives whose cars sent Gram rows."""

    cohort: str
    feature_set: str = "signals"
    drives: Count
    vehicles: Count
    drives_without_log: Annotated[Count | None, _OPTIONAL] = None
    rows: Count
    logs_version: Count
    grams_version: Count
    drives_sha256: Sha256


Seconds = Annotated[FiniteFloat, Field(gt=0)]


class LearnedFrom(Config):
    """The label of a model without a reference sensor: changes of the course over `change_s`.

    The intercept is estimated from `cars` that drive straight, with its uncertainty (None if
    unknown) and the standard deviation between cars.
    """

    label: Literal["course"]
    change_s: Seconds | Annotated[tuple[Seconds, ...], Field(min_length=2)]
    cars: Count
    intercept_uncertainty_deg: FiniteFloat | None
    intercept_spread_deg: FiniteFloat

    def __str__(self) -> str:
        times = self.change_s if isinstance(self.change_s, tuple) else (self.change_s,)
        intervals = ", ".join(f"{time:g}" for time in times)
        text = f"changes of the {self.label} over {intervals} s: the figures are of changes"
        if not self.cars:
            return f"{text}. No intercept: it goes through the origin"
        error = self.intercept_uncertainty_deg
        uncertainty = "unknown" if error is None else f"{error:.2g} deg"
        return (
            f"{text}. Intercept from straight driving of {pluralize(self.cars, 'car')}, "
            f"uncertainty {uncertainty}"
        )


class Prior(Config):
    """Simulated drives in the training set beside the cohort: `rows` of this `weight`."""

    campaign: str
    campaign_sha256: Sha256
    vehicles: tuple[str, ...]
    drives: Count
    rows: Count
    weight: ExactFraction


OptionValue = bool | int | Annotated[str, Field(max_length=100_000)]


class SelectedBy(Config):
    """The list, the name and the reason of a selection, and its options by name.

    Documents call the options `asked`.
    """

    model_config = ConfigDict(serialize_by_alias=True)

    model_list: str
    model: str
    reason: str
    config_sha256: str
    options: Annotated[
        dict[Identifier, OptionValue] | None,
        Field(
            validation_alias=AliasChoices("asked", "options"),
            serialization_alias="asked",
            exclude_if=lambda options: options is None,
        ),
    ] = None


LINE_ALONE = (
    "The figures are of the linear model alone: Gram rows contain no filter. "
    "score and evaluate examine the combination."
)


class CombinedWithFilter(Config):
    """Combination of the linear model of a manifest with a filter in the identified car.

    Attributes
    ----------
    method
        The winner among the combinations (`fleet_slip.regression.combination`).
    term
        The column with filter, linear model and weights; None if the linear model is better.
    rmse_deg, worst_rmse_deg
        RMSE of every method, cross-validated in inner groups of drives, and that of its worst
        group.
    groups
        Number of inner groups.
    measures
        Measured vehicle data, from which the car is identified again.
    """

    method: Literal["line", "filter", "constant", "by_lateral", "line_by_lateral"]
    term: Annotated[ModelTerm | None, _OPTIONAL] = None
    rmse_deg: dict[Identifier, NotNegative]
    worst_rmse_deg: dict[Identifier, NotNegative]
    groups: Count
    measures: VehicleMeasures
    reason: Annotated[str, Field(max_length=2000, exclude_if=lambda text: not text)] = ""
    """Why there is no filter."""

    @model_validator(mode="after")
    def _agrees(self) -> Self:
        if (self.term is None) != (self.method == "line"):
            raise ValueError("every method but the line has a column of filter and line")
        definition = self.term and self.term.definition
        if self.term and not isinstance(definition and definition.made, Blend):
            raise ValueError("its column does not contain a filter")
        return self

    def __str__(self) -> str:
        """Return which estimate is used where, as a sentence."""
        if self.reason:
            return f"The linear model alone: {self.reason}"
        figures = ", ".join(
            f"{name.replace('_', ' ')} {deg:.3f}" for name, deg in self.rmse_deg.items()
        )
        return f"{self._parts()}. RMSE in {self.groups} inner groups: {figures} deg."

    def _parts(self) -> str:
        blend = self.term and self.term.definition and self.term.definition.made
        if not isinstance(blend, Blend):
            return "The linear model alone: the filter does not improve it"
        if blend.line is None:
            return "The filter in the identified car alone: the linear model does not improve it"
        shares = _span(blend.shares, lambda share: f"{share / 2**16:.0%}")
        limits = _span(blend.limits, lambda limit: f"{math.degrees(limit / 2**16):.2g}")
        where = "" if blend.lateral is None else ", by lateral acceleration"
        parts = {
            "filter": f"The filter in the identified car, plus {shares} of the difference to the "
            "linear model",
            "line": f"The linear model, keeping {shares} of its difference to the filter",
        }
        return f"{parts[blend.anchor]}, clipped at {limits} deg{where}"


def _span(values: Sequence[int], text: Callable[[int], str]) -> str:
    return " to ".join(dict.fromkeys([text(min(values)), text(max(values))]))


_MADE: TypeAdapter[Made] = TypeAdapter(Made)

_WITH_COLUMNS = ("terms", "combination")
"""Keys of a manifest that contain definitions of columns."""


class Manifest(Config):
    """One model version.

    A document of unknown origin is validated with the `SignalCatalog` as context.
    """

    format: Literal[1] = 1
    name: Identifier
    label: ModelLabel
    intercept: FiniteFloat
    intercept_exact: ExactFraction
    through_origin: Annotated[bool, Field(exclude_if=lambda origin: not origin)] = False
    """True if it was fitted without an intercept."""
    terms: tuple[ModelTerm, ...] = Field(min_length=1)
    cross_validation: CrossValidated
    trained_on: TrainedOn
    selected_by: SelectedBy
    package_version: str
    learned_from: Annotated[LearnedFrom | None, _OPTIONAL] = None
    """None if the label is a reference sensor."""
    prior: Annotated[Prior | None, _OPTIONAL] = None
    combination: Annotated[CombinedWithFilter | None, _OPTIONAL] = None
    """None if no filter was compared: the terms are the estimate."""
    assumed: Annotated[
        tuple[Annotated[str, Field(max_length=200)], ...],
        Field(max_length=100, exclude_if=lambda assumed: not assumed),
    ] = ()
    """Assumptions of the mappings of its logs, with the assumed values."""

    @model_validator(mode="before")
    @classmethod
    def _expand_combinations(cls, content: Any, info: ValidationInfo) -> Any:
        """Insert each combination of columns, stored once in `made`, where columns name it."""
        if not isinstance(content, dict) or not isinstance(content.get("made"), dict):
            return content
        pending, combinations = dict(content["made"]), dict[str, Made]()

        def expand(node: Any) -> Any:
            if isinstance(node, list | tuple):
                return [expand(item) for item in node]
            if not isinstance(node, dict):
                return node
            node = {key: expand(value) for key, value in node.items()}
            if isinstance(name := node.get("made"), str):
                if name in pending:
                    parts = expand(pending.pop(name))
                    combinations[name] = _MADE.validate_python(parts, context=info.context)
                if name not in combinations:
                    raise ValueError(f"made: {name} is missing, or made of itself")
                node["made"] = combinations[name]
            return node

        remaining = {key: value for key, value in content.items() if key != "made"}
        expanded = {name: expand(content[name]) for name in _WITH_COLUMNS if name in content}
        return {**remaining, **expanded}

    @model_serializer(mode="wrap")
    def _collect_combinations(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Store each combination of columns once, in `made`."""
        content, combinations = handler(self), dict[str, Any]()

        def collect(node: Any) -> Any:
            if isinstance(node, list | tuple):
                return [collect(item) for item in node]
            if not isinstance(node, dict):
                return node
            if isinstance(node.get("made"), dict):
                name = node["of"]
                if name not in combinations:
                    combinations[name] = collect(node["made"])
                node = {**node, "made": name}
            return {key: collect(value) for key, value in node.items()}

        content |= {name: collect(content[name]) for name in _WITH_COLUMNS if name in content}
        return {**content, "made": combinations} if combinations else content

    @model_validator(mode="after")
    def _agrees(self) -> "Manifest":
        _require_rounded(self.intercept, self.intercept_exact)
        if self.through_origin and self.intercept_exact:
            raise ValueError("says that it goes through the origin, but has an intercept")
        return self

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the model's inputs."""
        return tuple(term.signal for term in self.terms)

    @property
    def line_remark(self) -> str:
        """Remark on figures from Gram rows of a version with a filter; empty without a filter."""
        has_filter = self.combination is not None and self.combination.term is not None
        return LINE_ALONE if has_filter else ""

    @property
    def estimate(self) -> "Manifest":
        """The manifest whose terms are the whole estimate: the combination is a term."""
        if self.combination is None or self.combination.term is None:
            return self
        changes = {"terms": (self.combination.term,), "combination": None}
        return self.model_copy(update={**changes, "intercept": 0.0, "intercept_exact": Fraction(0)})

    def counts_model(self, catalog: Catalog, feature_set: str | None = None) -> "LinearModel":
        """Return the model of counts, exactly; see `counts_coefficients`."""
        from fleet_slip.regression.least_squares import LinearModel  # noqa: PLC0415 - not for show

        coefficients, intercept = self.counts_coefficients(catalog, feature_set)
        label = self.label.signal
        return LinearModel(tuple(coefficients), label, tuple(coefficients.values()), intercept)

    def counts_coefficients(
        self, catalog: Catalog, feature_set: str | None = None
    ) -> tuple[dict[str, Fraction], Fraction]:
        """Return the coefficient of each signal, and the intercept, for counts, exactly.

        For a feature set of changes there is no intercept, and no calibration parameter of the car:
        constants do not change.
        """
        changes = feature_set is not None and catalog.feature_set(feature_set).change_ticks
        # Counts have the current scale of a signal, which may have changed since the publication.
        self.require_same_counts(catalog.signals)
        scales = catalog.input_scales
        unit = scales[self.label.signal]
        coefficients = {
            term.signal: term.coefficient_exact
            * (scales[term.signal] if term.logged else term.scale_exact)
            / unit
            for term in self.terms
            if not (changes and term.alone)
        }
        return coefficients, Fraction(0) if changes else self.intercept_exact / unit

    def columns(self, signals: SignalCatalog) -> tuple[str, ...]:
        """Return the columns in SI units that the model needs, each once, in term order."""
        columns = (
            column
            for term in self.terms
            for column in (
                [term.column] if term.logged else [signals[name].column for name in term.inputs]
            )
        )
        return tuple(dict.fromkeys(columns))

    @property
    def features(self) -> dict[str, Definition]:
        """Definition of each input that is a feature of 16 bits."""
        return {term.signal: plain_column(term.signal, term.sql) for term in self.terms if term.sql}

    def require_same_counts(self, signals: SignalCatalog) -> None:
        """Raise `RefusedError` if a signal of a column over time has another scale now."""
        for term in self.terms:
            for name, scale in (term.signal_scales or {}).items():
                if name not in signals.signals or signals[name].scale != scale:
                    raise RefusedError(
                        f"{self.name}: {term.signal} was defined when a count of {name} was worth "
                        f"{scale}, and the signal catalog says otherwise. Publish it again."
                    )

    @property
    def definitions(self) -> dict[str, Definition]:
        """Definition of each input that has one: columns over time."""
        return {term.signal: term.definition for term in self.terms if term.definition}

    @property
    def first_stage_digest(self) -> str | None:
        """Digest of the first-stage model whose estimate is an input; None without."""
        rows = (row for definition in self.definitions.values() for row in definition.rows())
        digests = (row.made.line for row in rows if isinstance(row.made, Combination))
        return next(filter(None, digests), None)

    def properties(self, on_board: str = "") -> dict[str, str]:
        """Return the content of `show` by name; `on_board` are the costs in a car."""
        from fleet_slip.warehouse.database import describe_cohort  # noqa: PLC0415 - SQL

        figures, trained = self.cross_validation, self.trained_on
        drives = f"{pluralize(trained.drives, 'drive')} of {pluralize(trained.vehicles, 'car')}"
        alone = ", of the linear model alone" * bool(self.line_remark)
        prior, digest = self.prior, self.first_stage_digest
        noise, noise_deg = "unknown, and part of the RMSE", figures.label_noise_deg
        if noise_deg is not None:
            rmse_deg = figures.beyond_label_noise_deg
            noise = f"{noise_deg:.4f} deg, without which the RMSE is {rmse_deg:.4f} deg"
        properties = {
            "correlation": (
                f"{figures.correlation:.4f} (s.e. {figures.correlation_standard_error:.2g})"
            ),
            "RMSE": f"{figures.rmse_deg:.4f} deg{alone}",
            "label noise": noise,
            "error std": f"{figures.error_std_deg:.4f} deg",
            "error mean": f"{figures.error_mean_deg:+.4f} deg",
            "on board": on_board,
            "cross-validation": f"{pluralize(figures.folds, 'fold')} by {figures.folds_by}",
            "cohort": (
                f"{drives}, {pluralize(trained.rows, 'row')}{describe_cohort(trained.cohort)}"
            ),
            "tables": f"logs version {trained.logs_version}, grams {trained.grams_version}",
            "selected": f"model {self.selected_by.model} of {self.selected_by.model_list}",
            "why": self.selected_by.reason,
            "assumed": "; ".join(self.assumed),
            "with filter": str(self.combination or ""),
            "first-stage model": digest and f"{digest}, of the feature set {trained.feature_set}",
            "prior": prior
            and f"{prior.campaign}: {pluralize(prior.drives, 'simulated drive')} of "
            f"{', '.join(prior.vehicles)}, each row with the weight {prior.weight}",
            "learned from": str(self.learned_from or ""),
        }
        return {name: text for name, text in properties.items() if text}

    def same_estimator(self, other: "Manifest") -> bool:
        """Return True if both have the same terms and combination from the same training data."""
        return self.has_same_terms(other) and self.combination == other.combination

    def has_same_terms(self, other: "Manifest") -> bool:
        """Return True if both have the same terms from the same training data."""
        return (
            self.intercept_exact == other.intercept_exact
            and self.terms == other.terms
            and self.trained_on.rows == other.trained_on.rows
            and self.trained_on.drives == other.trained_on.drives
        )


def require_model_name(name: str) -> str:
    """Return a name that a model or an alias may have. Raises `UsageError` otherwise."""
    if not re.fullmatch(IDENTIFIER_PATTERN, name):
        raise UsageError(
            f"{name!r} cannot be the name of a model: use small letters, digits and _, beginning "
            "with a letter, at most 41."
        )
    return name


# The training set of a version without the names of drives. With the name of a drive one can test
# if the set contains it.

_SALT = b"fleet-slip trained drives\n"


@dataclass(frozen=True)
class TrainedDrives:
    """Sorted hashes of the training drives of a version, salted with its model's name."""

    name: str
    salted: "Hashes"

    @classmethod
    def from_hashes(cls, name: str, drives: "Hashes") -> "TrainedDrives":
        """Build a set from the hashes of the names of drives."""
        salted = _salt(name, drives)
        salted.sort()
        return cls(name, salted)

    @classmethod
    def from_content(cls, name: str, content: bytes) -> "TrainedDrives":
        """Read the content of a file."""
        import numpy as np  # noqa: PLC0415 - not for show

        return cls(name, np.frombuffer(content, dtype=">u8").astype(np.uint64))

    @property
    def content(self) -> bytes:
        """Content of a file: 8 bytes a drive."""
        return self.salted.astype(">u8").tobytes()

    def among(self, drives: "Hashes") -> "BoolArray":
        """Return the mask of drives, by the hashes of their names, that are in the set."""
        import numpy as np  # noqa: PLC0415 - not for show

        mask: BoolArray = np.isin(_salt(self.name, drives), self.salted)
        return mask


def checksum_of_drives(content: bytes) -> str:
    """Return the SHA-256 of a file of training drives, as a manifest stores it."""
    return sha256(content).hexdigest()


def _salt(name: str, drives: "Hashes") -> "Hashes":
    """Return the salted hash of each drive, in the order of the drives."""
    import numpy as np  # noqa: PLC0415 - not for show

    salt, numbers = _SALT + name.encode(), drives.astype("<u8").tobytes()
    parts = (sha256(salt + numbers[i : i + 8]).digest()[:8] for i in range(0, len(numbers), 8))
    return np.frombuffer(b"".join(parts), dtype=">u8").astype(np.uint64)
