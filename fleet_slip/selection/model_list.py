"""Model lists: the candidates that a selection compares, read from `configs/models/*.toml`."""

from collections.abc import Iterable, Sequence
from typing import Literal

from pydantic import Field, field_validator, model_validator

from fleet_slip.canonical import canonical_json, sha256_of
from fleet_slip.catalogue.feature_sets import PLAIN
from fleet_slip.catalogue.features import features
from fleet_slip.catalogue.signals import Identifier
from fleet_slip.config import Config, load_config
from fleet_slip.errors import QuestionError, UsageError
from fleet_slip.grams.cohorts.fold_sums import SummedCohort
from fleet_slip.grams.cohorts.folding import Folding
from fleet_slip.grams.cohorts.gram_cohort import Cohort
from fleet_slip.resources import find_config
from fleet_slip.selection.request import DEFAULT_MOST, Label

INPUTS_TOLD = 30
"""Inputs, or families of them, in a message."""


class CandidateModel(Config):
    """A named set of signals or features; a family of windows or gates stands for its members."""

    name: str = Field(min_length=1, max_length=60)
    signals: tuple[Identifier, ...] = Field(min_length=1)

    @field_validator("signals")
    @classmethod
    def _families_are_their_members(cls, signals: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(member for name in signals for member in features().members(name))

    @model_validator(mode="after")
    def _signals_are_inputs(self) -> "CandidateModel":
        inputs = features().inputs
        for name in self.signals:
            if name not in inputs:
                raise ValueError(
                    f"model {self.name!r}: {name!r} is not an input. Inputs: {_told(inputs)}"
                )
        if len(set(self.signals)) < len(self.signals):
            raise ValueError(f"model {self.name!r} names a signal twice")
        return self


class Search(Config):
    """How to choose among many inputs: at most so many columns, by `rule`.

    `best` takes the best cross-validated correlation; `worth` the fewest columns whose error is
    negligibly larger (`fleet_slip.regression.choice.winner`).
    """

    method: Literal["forward", "backward", "exchange"] = "forward"
    most: int = Field(default=DEFAULT_MOST, ge=1, le=200)
    rule: Literal["best", "worth"] = "worth"


class ModelList(Config):
    """Candidates in their declared order, the feature set and the folds to compare them on.

    `label` may stand for a reference sensor. What a `search` finds joins, and its rule decides.
    """

    description: str = Field(min_length=1)
    label: Label | None = None
    features: Identifier = PLAIN
    folds: Folding = Folding()
    model: tuple[CandidateModel, ...] = Field(min_length=1)
    search: Search | None = None

    @model_validator(mode="after")
    def _names_differ(self) -> "ModelList":
        names = [candidate.name for candidate in self.model]
        if len(set(names)) < len(names):
            raise ValueError("two models have the same name")
        return self

    @model_validator(mode="after")
    def _feature_set_has_the_inputs(self) -> "ModelList":
        known = features()
        if self.features not in {PLAIN, *known.sets}:
            raise ValueError(f"features: no feature set is called {self.features!r}")
        inputs = known.feature_set(self.features).inputs
        for candidate in self.model:
            absent = [name for name in candidate.signals if name not in inputs]
            if absent:
                raise ValueError(
                    f"model {candidate.name!r}: {', '.join(absent)} is not in the feature set "
                    f"{self.features!r}. Its inputs: {', '.join(inputs)}"
                )
        return self

    @property
    def sha256(self) -> str:
        """Checksum of what the list says, whatever its layout."""
        content = self.model_dump(mode="json", exclude_defaults=True)
        return sha256_of(canonical_json(content))


def load_model_list(name_or_path: str) -> ModelList:
    """Return a shipped model list by name, or one from a TOML file. Raises `ConfigError`."""
    return load_config(find_config("models", name_or_path), ModelList)


def nested_candidates(order: Sequence[str]) -> tuple[CandidateModel, ...]:
    """Return the models of an order's first 1..k inputs (paper, section II.B)."""
    return tuple(
        CandidateModel(name=f"first {size}", signals=tuple(order[:size]))
        for size in range(1, len(order) + 1)
    )


WHOLE_SET = "catalogue"
"""As an order of signals: all inputs of the feature set, in its order."""


def inputs_of(cohort: Cohort | SummedCohort, order: str) -> tuple[str, ...]:
    """Return the order of inputs in a text, `catalogue` being all; raises as `require_inputs`."""
    if order == WHOLE_SET:
        return cohort.inputs
    return require_inputs(order.split(","), cohort.feature_set)


def require_inputs(names: Sequence[str], feature_set: str) -> tuple[str, ...]:
    """Return the inputs, of a family of windows or gates its members.

    Raises `QuestionError` for an unknown one, `UsageError` for a repeated one.
    """
    known = features().feature_set(feature_set).inputs
    order = tuple(one for name in names for one in features().members(name.strip()))
    if unknown := [name for name in order if name not in known]:
        raise QuestionError(
            f"{','.join(order)}: {', '.join(unknown)} is not an input. Inputs of the feature set "
            f"{feature_set}: {_told(known)}."
        )
    if len(set(order)) < len(order):
        raise UsageError(f"{','.join(order)}: an input stands twice.")
    return order


def _told(inputs: Iterable[str]) -> str:
    """Return names of inputs in a line, families by their own, and how many more there are."""
    names = list(features().families(inputs))
    more = f" and {len(names) - INPUTS_TOLD} more (fleet-slip features)"
    return ", ".join(names[:INPUTS_TOLD]) + (more if len(names) > INPUTS_TOLD else "")
