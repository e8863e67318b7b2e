"""The paper's claims in its order, each judged by a stated criterion from the report's data."""

from dataclasses import dataclass

from fleet_slip.comparison.report.claims.claim import Claim, Verdict
from fleet_slip.comparison.report.claims.conditions import CONDITIONS
from fleet_slip.comparison.report.claims.method import METHOD
from fleet_slip.comparison.report.claims.models import MODELS
from fleet_slip.comparison.report.claims.outcome import OUTCOME
from fleet_slip.comparison.report.findings.report_data import ReportData

CLAIMS: tuple[Claim, ...] = (*METHOD, *MODELS, *CONDITIONS, *OUTCOME)


@dataclass(frozen=True)
class Judged:
    """A claim and its verdict."""

    claim: Claim
    verdict: Verdict


def judge_claims(data: ReportData) -> tuple[Judged, ...]:
    """Judge all claims."""
    return tuple(Judged(claim, claim.judge(data)) for claim in CLAIMS)
