"""The part of a `Fleet` that publishes models and serves them."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fleet_slip.api.calls import Rooted, record_call
from fleet_slip.api.cohort import FleetCohort
from fleet_slip.errors import RefusedError
from fleet_slip.models.aliases import CHAMPION
from fleet_slip.models.manifest import require_model_name
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.models.versions import Registry

if TYPE_CHECKING:
    import pyarrow as pa

    from fleet_slip.export.estimator import Estimator
    from fleet_slip.export.files import Target
    from fleet_slip.models.diff import Difference
    from fleet_slip.models.manifest import Manifest
    from fleet_slip.models.publish import DryRun, Publication
    from fleet_slip.selection.select_models import RequestedSelection


class PublishedModels(Rooted):
    """Published models. A reference is `NAME@VERSION`, `NAME@ALIAS`, or `NAME` for its champion.

    None stands for the only model that there is.
    """

    def models(self, name: str | None = None) -> "pa.Table":
        """Return all published versions, or those of one model, as the view `models` has them.

        `trained_on_forgotten`: whether drives were forgotten since. Raises `QuestionError`,
        `StorageError`.
        """
        from fleet_slip.maintenance.marked_models import marked_models

        self.warehouse.require()
        registry = self.registry()
        if name is not None:
            registry.require(name)
        found = registry.as_table(name)
        marked = marked_models(self.root)
        pairs = zip(found["name"].to_pylist(), found["version"].to_pylist(), strict=True)
        return found.append_column(
            "trained_on_forgotten", [[f"{name}@{version}" in marked for name, version in pairs]]
        )

    def model(self, reference: str | None = None) -> ModelVersion:
        """Return the version that a reference names, by default the only model.

        Raises `QuestionError` for an unknown one, `StorageError` for one that was changed, and
        `RefusedError` for one without a required signature.
        """
        return self.registry().resolve(reference)

    @record_call
    def publish(
        self,
        name: str,
        choice: "RequestedSelection | FleetCohort | None" = None,
        *,
        force: bool = False,
        candidate: bool = False,
    ) -> "Publication":
        """Make a selection's winner the next version of a model, and its champion.

        `choice` is what `FleetCohort.select` returned; or a cohort, None for that of before, on
        which the model is trained as it was before, or from the usual list. A winner that is worse
        than the champion on the same cohort and folds needs `force`. A `candidate` waits for
        `promote`, and so does any winner while the champion is held.

        Raises `RefusedError` for a worse winner, a late or false course, or first measured drives
        that contradict any car; `UsageError` for an invalid name, and
        what `FleetCohort.select` raises.
        """
        from fleet_slip.models.publish import publish

        registry = self.registry()
        manifest, selection = self._challenger(name, choice, force=force, candidate=candidate)
        return publish(registry, manifest, selection, force=force, candidate=candidate)

    def would_publish(
        self,
        name: str,
        choice: "RequestedSelection | FleetCohort | None" = None,
        *,
        force: bool = False,
        candidate: bool = False,
    ) -> "DryRun":
        """Tell what `publish` of the same would come to, a refusal too; nothing is written."""
        from fleet_slip.models.publish import DryRun, would_publish

        registry = self.registry()
        try:
            manifest, selection = self._challenger(name, choice, force=force, candidate=candidate)
            return would_publish(registry, manifest, selection, force=force, candidate=candidate)
        except RefusedError as error:
            return DryRun(name, False, str(error), refused=True)

    def _challenger(
        self,
        name: str,
        choice: "RequestedSelection | FleetCohort | None",
        *,
        force: bool,
        candidate: bool,
    ) -> "tuple[Manifest, RequestedSelection]":
        """Return a selection's winner, whose drives and course are looked at unless forced."""
        from fleet_slip.models.acceptance.first_look import require_sound_drives
        from fleet_slip.models.acceptance.sound_course import require_in_time, require_sound_course
        from fleet_slip.models.describe_winner import manifest_of, with_straight_intercept

        require_model_name(name)
        selection = self._chosen(name, choice)
        manifest = with_straight_intercept(self.warehouse, manifest_of(selection, name), selection)
        if manifest.learned_from and not force:
            delays_s = require_in_time(self.warehouse, manifest)
            require_sound_course(self.warehouse, manifest, delays_s)
        if not (force or candidate):
            registry = self.registry()
            champion, made = registry.champion(name), None
            if champion:
                made = registry.trained_drives(champion.manifest)
            if champion is None or made is not None:
                settled = len(champion.manifest.terms) if champion else 0
                require_sound_drives(self.warehouse, manifest, made, settled)
        return manifest, selection

    def _chosen(
        self, name: str, choice: "RequestedSelection | FleetCohort | None"
    ) -> "RequestedSelection":
        from fleet_slip.models.recipe import recipe_for
        from fleet_slip.selection.request import SelectionRequest

        if choice is not None and not isinstance(choice, FleetCohort):
            return choice
        condition, unexamined = (choice.condition, choice.unexamined) if choice else (None, False)
        recipe = recipe_for(self.registry(), name, SelectionRequest(), condition)
        cohort = FleetCohort(self.warehouse, recipe.cohort, unexamined)
        return cohort.select(**vars(recipe.request))

    @record_call
    def promote(self, reference: str, alias: str = CHAMPION) -> ModelVersion:
        """Point an alias at a version; return the version. Raises `UsageError`, and as `model`."""
        require_model_name(alias)
        version = self.model(reference)
        self.registry().promote(version.manifest.name, version.version, alias)
        return version

    @record_call
    def rollback(self, name: str, alias: str = CHAMPION) -> ModelVersion:
        """Point an alias back at the version before; return it. It is held there as by `pin`.

        Raises `RefusedError` if it never had another, and what `model` raises.
        """
        registry = self.registry()
        return registry.load(name, registry.rollback(name, alias))

    @record_call
    def pin(self, name: str, alias: str = CHAMPION) -> ModelVersion:
        """Keep an alias where it is until `promote` or `unpin`; return its version, as `model`."""
        registry = self.registry()
        return registry.load(name, registry.hold(name, alias, "pin"))

    @record_call
    def unpin(self, name: str, alias: str = CHAMPION) -> ModelVersion:
        """Let publications move an alias again; return its version. Raises as `model`."""
        registry = self.registry()
        return registry.load(name, registry.hold(name, alias, "unpin"))

    def diff(self, one: str | ModelVersion, other: str | ModelVersion) -> "Difference":
        """Tell two versions apart: data, signals, coefficients, figures. Raises as `model`."""
        from fleet_slip.models.diff import compare_versions

        return compare_versions(self.registry(), self.resolve(one), self.resolve(other))

    @record_call
    def import_model(self, file: Path) -> ModelVersion:
        """Bring a version in that another data root exported to JSON; return it.

        It becomes its model's next version, with its origin and no alias; the latest is returned if
        it is the same estimator. Raises `InputError` for no such export, or a changed one,
        `RefusedError` if a signal means something else here.
        """
        from fleet_slip.export.importing import import_version

        return import_version(self.registry(), file)

    def estimator(
        self, model: str | ModelVersion, car: Mapping[str, Any] | None = None
    ) -> "Estimator":
        """Return a version that estimates a drive sample by sample, as a car does.

        `car` is what the car knows of itself, by name: drive columns such as `mass_kg`, and numbers
        of the view `calibration`, in SI units. Raises `InputError` for what the version does not
        use, and what `export` and `model` raise.
        """
        from fleet_slip.export.estimator import Estimator

        return Estimator(self.resolve(model).manifest, car)

    def export(
        self,
        model: str | ModelVersion | None,
        to: "Target",
        output: Path,
        *,
        with_gram: bool = False,
    ) -> list[Path]:
        """Write a version as a program for elsewhere into a folder; return the files.

        `with_gram` adds to C what counts Gram rows in the car, for `ingest`. Exports carry the
        version's checksum, the hash of its drives, and checks of made-up inputs; no tick of a log.
        Raises `RefusedError` if the angle's error has no bound or counts mean something else now,
        `UsageError` for an unknown target, `ConfigError` without what it needs, and what `model`
        raises.
        """
        from fleet_slip.export.files import export_files
        from fleet_slip.files.local_folder import LocalFolder

        folder = LocalFolder(output)
        files = export_files(self.resolve(model), self.warehouse, to, with_gram=with_gram)
        for name, content in files.items():
            folder.put(name, content)
        return [output / name for name in files]

    def log_to_mlflow(self, model: str | ModelVersion, uri: str) -> str:
        """Log a version to an MLflow server and register it, once; return its number there.

        It is a pyfunc model with signature, input example, metrics and tags. Raises `ConfigError`
        without the library, `UsageError` for a password in the URI, `StorageError` if the server
        does not take it, and what `export` and `model` raise.
        """
        from fleet_slip.export.files import log_version

        return log_version(self.resolve(model), self.warehouse, uri)

    def registry(self) -> Registry:
        """Return the registry of models."""
        return Registry.of(self.warehouse)

    def resolve(self, model: str | ModelVersion | None) -> ModelVersion:
        """Return the version that a reference names; a version is returned as it is."""
        return model if isinstance(model, ModelVersion) else self.model(model)
