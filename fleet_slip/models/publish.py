"""From a selection's winner to a published model version, unless the champion is better."""

import functools
from dataclasses import dataclass
from typing import Any

from fleet_slip.models.acceptance.judgement import judge
from fleet_slip.models.aliases import CANDIDATE, CHAMPION, AliasMove
from fleet_slip.models.describe_winner import drives_of
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.models.versions import Registry
from fleet_slip.selection.select_models import Selection


@dataclass(frozen=True)
class Publication:
    """What publishing came to."""

    version: ModelVersion
    new: bool
    reason: str
    candidate: bool = False
    """Whether it waits for somebody to promote it."""

    def as_dict(self) -> dict[str, Any]:
        """Return what `publish --json` prints."""
        return {
            "model": self.version.manifest.name,
            "version": self.version.version,
            "new": self.new,
            "candidate": self.candidate,
            "reason": self.reason,
            "sha256": self.version.sha256,
        }


def publish(
    registry: Registry,
    manifest: Manifest,
    selection: Selection[Any],
    *,
    force: bool = False,
    candidate: bool = False,
) -> Publication:
    """Make the winner the next version of its model, and its champion.

    It must be above the floor, and no worse than the champion and the best of the champions so far
    (`champion_rules`), else it is refused (`RefusedError`) unless forced. A `candidate` waits for
    somebody to promote it, and so does whatever is published while the champion is held by
    `rollback` or `pin`. A challenger that is the same estimator from the same rows changes nothing.
    If the champion changes meanwhile, all is decided again.
    """
    history = registry.history(manifest.name)

    @functools.cache
    def added() -> ModelVersion:
        return registry.add(manifest, drives_of(selection, manifest.name))

    def publication(newest_move: int) -> Publication | None:
        found = _decide(registry, manifest, selection, force=force, candidate=candidate)
        if found.stays:
            return Publication(found.stays, False, found.reason)
        if found.waits:
            return _wait(registry, added(), newest_move, found)
        version = added()
        published = registry.make_champion(version, after=newest_move, best=found.best)
        return Publication(version, True, found.reason) if published else None

    return history.decide(publication)


@dataclass(frozen=True)
class DryRun:
    """What publishing would come to.

    Attributes:
        model: its name.
        publishes: whether there would be a new version, as champion or as candidate.
        reason: what was compared, else why nothing would be published.
        candidate: whether it would wait for somebody to promote it.
        refused: whether `publish` would raise `RefusedError`.
    """

    model: str
    publishes: bool
    reason: str
    candidate: bool = False
    refused: bool = False


def would_publish(
    registry: Registry,
    manifest: Manifest,
    selection: Selection[Any],
    *,
    force: bool = False,
    candidate: bool = False,
) -> DryRun:
    """Tell what `publish` of the same would come to; nothing is written. Raises as it does."""
    found = _decide(registry, manifest, selection, force=force, candidate=candidate)
    if found.stays:
        return DryRun(manifest.name, False, found.reason)
    if not found.waits:
        return DryRun(manifest.name, True, found.reason)
    waiting = registry.history(manifest.name).pointed_at(CANDIDATE)
    newest = max(registry.versions(manifest.name), default=None)
    there = (
        waiting is not None
        and waiting == newest
        and (registry.load(manifest.name, waiting).manifest.same_estimator(manifest))
    )
    reason = f"{found.reason} {_why(manifest.name, found.held)}."
    return DryRun(manifest.name, not there, reason, candidate=True)


@dataclass(frozen=True)
class _Decision:
    """What is to become of a challenger.

    Attributes:
        reason: what was compared, as a sentence.
        stays: the champion, if nothing is published.
        waits: whether it becomes the candidate.
        held: the move that holds the champion.
        best: the number of the best champion so far, as `Registry.make_champion` takes it.
    """

    reason: str
    stays: ModelVersion | None = None
    waits: bool = False
    held: AliasMove | None = None
    best: int | None = None


def _decide(
    registry: Registry,
    manifest: Manifest,
    selection: Selection[Any],
    *,
    force: bool,
    candidate: bool,
) -> _Decision:
    """Decide what becomes of a challenger. Raises `RefusedError`."""
    champion = registry.champion(manifest.name)
    if champion and champion.manifest.same_estimator(manifest):
        return _Decision("The champion is this very model.", champion)
    held = registry.history(manifest.name).held_by(CHAMPION)
    judgement = judge(registry, champion, manifest, selection)
    if not force and not candidate:
        judgement.require_passed(manifest.name)
    if champion and judgement.drifts and not (force or candidate or held):
        reason = f"The champion stays, since it is better for sure. {judgement.reason}"
        return _Decision(reason, champion)
    best = None if judgement.problems else judgement.best
    return _Decision(judgement.reason, None, candidate or held is not None, held, best)


def _wait(
    registry: Registry, version: ModelVersion, newest: int, found: _Decision
) -> Publication | None:
    """Make a version the candidate; return None if an alias moved after the move given."""
    name = version.manifest.name
    history = registry.history(name)
    there = history.pointed_at(CANDIDATE) == version.version
    if not there and not history.move(CANDIDATE, version.version, "publish", after=newest):
        return None
    until = f"until: fleet-slip promote {version.reference}"
    reason = f"{found.reason} {_why(name, found.held)}, {until}"
    return Publication(version, not there, reason, candidate=True)


def _why(name: str, held: AliasMove | None) -> str:
    """Say why a version waits."""
    if held is None:
        return "It is a candidate"
    done = f"{_DONE[held.command]} on {held.at:%Y-%m-%d %H:%M} UTC"
    return f"{name}@{held.version} stays champion since it was {done}"


_DONE = {"rollback": "rolled back to", "pin": "pinned"}
