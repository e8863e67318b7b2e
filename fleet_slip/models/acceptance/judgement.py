"""What the rules for champions, and the drives that made this one, say of a challenger."""

from dataclasses import dataclass
from typing import Any

from fleet_slip.errors import DataError, QuestionError, RefusedError, StorageError
from fleet_slip.models.acceptance.champion_rules import compare, find_faults
from fleet_slip.models.acceptance.vouching_drives import ODD, odd_gain
from fleet_slip.models.aliases import CHAMPION
from fleet_slip.models.manifest import Manifest
from fleet_slip.models.model_version import ModelVersion
from fleet_slip.models.versions import Registry
from fleet_slip.selection.select_models import Selection


@dataclass(frozen=True)
class Judgement:
    """What the rules say of a challenger.

    Attributes:
        problems: why it is not to become champion.
        compared: with what it was compared.
        best: the number of a champion of before that is better than it; None if none is.
        drifts: whether the champion is better for sure, if not by what is worth a refusal.
    """

    problems: tuple[str, ...]
    compared: str
    best: int | None = None
    drifts: bool = False

    @property
    def reason(self) -> str:
        """The problems, else what was compared, as a sentence."""
        text = "; ".join(self.problems) or self.compared
        return f"{text[:1].upper()}{text[1:]}."

    def require_passed(self, name: str) -> None:
        """Raise `RefusedError` if there are problems."""
        if self.problems:
            raise RefusedError(
                f"{name} was not published: {'; '.join(self.problems)}. Look at the data, or "
                "publish it with force all the same."
            )


def judge(
    registry: Registry,
    champion: ModelVersion | None,
    manifest: Manifest,
    selection: Selection[Any],
) -> Judgement:
    """Compare a challenger with the champion, and with the best of the champions so far."""
    problems = find_faults(manifest, champion.manifest if champion else None)
    if champion is None:
        return Judgement(tuple(problems), "It is the first version")
    try:
        incumbents = _incumbents(registry, champion)
        comparison = compare(selection, incumbents)
    except (DataError, QuestionError) as error:
        problems.append(f"the champion {champion.reference} cannot be compared ({error})")
        return Judgement(tuple(problems), "")
    if comparison.contradicted:
        problems.append(
            f"the label runs against what {champion.reference} estimates: is it reversed? "
            f"{comparison}"
        )
    better = [one.name for one in comparison.better]
    if champion.reference in better:
        problems.append(f"it is worse than the champion: {comparison}")
    elif better:
        problems.append(
            f"it is worse than {better[0]}, the best of the champions so far, from which small "
            f"steps have led away: {comparison}. To begin anew at the champion: fleet-slip promote "
            f"{champion.reference}"
        )
    then = champion.manifest
    if then.learned_from is None and manifest.learned_from is None:
        was, now = then.cross_validation.rmse_deg, comparison.incumbents[0].pooled.rmse_deg
        if now > ODD * was and not problems:
            problems.append(
                f"{champion.reference} had an RMSE of {was:.4f} deg on drives that did not train "
                f"it, and has {now:.4f} deg on these: most of it comes from drives unlike those "
                f"that vouch for it. Look at them before they teach: {comparison}"
            )
    try:
        if not problems and (odd := odd_gain(registry, selection, champion)):
            problems.append(odd)
    except StorageError as error:
        problems.append(f"it cannot be judged on the drives that made the champion: {error}")
    best = next((one.version for one in incumbents if one.reference == comparison.best), None)
    return Judgement(tuple(problems), str(comparison), best, comparison.drifts)


def _incumbents(registry: Registry, champion: ModelVersion) -> list[ModelVersion]:
    """Return the champion, and the best of the champions so far if that is another version."""
    name = champion.manifest.name
    best = registry.history(name).best_of(CHAMPION)
    others = [] if best in (None, champion.version) else [registry.load(name, best)]
    return [champion, *others]
