"""The paper's claims in its order, each judged by a stated criterion from the report's data."""

from dataclasses import dataclass

from fleet_slip.report.claims.claim import Claim, Verdict
from fleet_slip.report.claims.conditions import CONDITIONS
from fleet_slip.report.claims.method import METHOD
from fleet_slip.report.claims.models import MODELS
from fleet_slip.report.claims.outcome import OUTCOME
from fleet_slip.report.data import ReportData

CLAIMS: tuple[Claim, ...] = (*METHOD, *MODELS, *CONDITIONS, *OUTCOME)


@dataclass(frozen=True)
class Judged:
    """A claim and its verdict."""

    claim: Claim
    verdict: Verdict


def judge_claims(data: ReportData) -> tuple[Judged, ...]:
    """Judge all claims."""
    return tuple(Judged(claim, claim.judge(data)) for claim in CLAIMS)
