"""Simulated data stay the same: the bits of rows and the digests of batches.

The sums were taken before cars, roads and sensors had imperfections; those of `proving_ground` and
of drives with imperfections before roads were rough; those of `fleet_realistic` and `imperfect`
since a load of its own place does not move where the angle is meant. Digests name files and tell a
changed campaign, so that they must not change either.
"""

from hashlib import sha256

import polars as pl
import pyarrow as pa
import pytest

from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.campaign import Batch, load_campaign
from fleet_slip.simulation.scenario import load_scenario
from fleet_slip.simulation.simulate import simulate_batch
from tests.support.catalog import SIGNALS

CAMPAIGNS = {
    "smoke": (
        "5d9ab80292e3037801ae17ae8e56d9460e2fb7b487c5046e12322338e79508d2",
        "8c902a19179045c97d8d2e705f023090ed8f44c36811aa72367a3b75cf9ae6c3",
        "55b8f5193aa756a8187a5a51b98ae34cd27c2dfbf7e66d73895c8edef0514a8a",
    ),
    "waterford": (
        "6c7228b1d941ffd430f05dce25053b0ec60c98d3a6ac477f8e24fa6fc2ab700b",
        "a3bbd430b7069bbf649048c508a201dd8aacadf9e8150892ed6e31ea1b72d0b4",
        "82610b0951963940ee027d862629947a91253cebdb1302f35910e85d5ac91002",
    ),
    "fleet": (
        "5feaa7499f9b777a1e15a4a095d03dab0c64889dd6d9eaae236cca4b20f1a235",
        "666d56a88a5707d9955eccd5973d30c27ede9245abee08b2108475bb2d4aff24",
        "de6c065a4801c718125e3b3e2c994ac0a47fe6e0dc7f1f10aee7d4ea7a0ab77c",
    ),
    "proving_ground": (
        "016cdde8f2f7e919bba668bf9bc43eb2503b4ad58da57fcfb35cd32d602eed9d",
        "b0160f9ba855a7ecadb3597b1538a230bec9f5cad536d937bf442d986992be26",
        "b8127600b9df9adde3d0397e17edb1af18aa32e74b89798aa13315cdf756c1af",
    ),
    "fleet_realistic": (
        "811e4a664234c2ad30f5c0450d34b9cb01d8746d20931b4d094672d7f4c9f134",
        "4cdabd00be7d1b9bf7119159a6fabc8de40ed09fd6004e20da7d0dba19d231d3",
        "d22a13985e36ea65522d48fdc13fc08a009eb37518566e187110ade566bd9bb8",
    ),
}
"""Digest of the campaign, of its first batch, and of the rows of that batch's first two drives."""

SCENARIOS = {
    "nominal": (
        "bdd969f0355eaf27df0ed93fd8d615235f538c1f597820ba18a202c8f89c1965",
        "dd90dec81007115530cbe34f68ed40345ba7bd5aa5dab4ccdc4bb17399fea7cb",
    ),
    "imperfect": (
        "1039ce481c01490a6d2bdaec114dfbb936a9241a2441f271d4522692892a47ed",
        "5ae6553a0fb46d74fb3327f1620609941adb3973977a54ff4292449a49c61e85",
    ),
    "adhesion_0_4": (
        "9166610825998f76ca310a6aaeab4d2025651cc91a4342a4dc0fc748f087dc6e",
        "afcaaaa354d9b5df707adb16d26068c575fd1dbf50b41bed3ecc11fded6191ff",
    ),
    "car_suv": (
        "ea69be56fe3ab7116daee6f8f17d72f7fc41a6cfc02235ecd98827935748ab02",
        "68f2364bd7634d1fd37be3cfc33de1d09b70404a2cc1afe879f779b344f93ae6",
    ),
}


def checksum(rows: pa.Table) -> str:
    """Return a checksum of the values of a table, whatever its chunks, but for what came later."""
    digest = sha256()
    for name in rows.drop_columns(["rows", "duration_s"]).column_names:
        digest.update(f"{name}{pl.Series(rows[name]).to_list()}".encode())  # faster than Arrow's
    return digest.hexdigest()


def short(batch: Batch) -> Batch:
    """Return the batch with its first two drives only."""
    return Batch(batch.campaign, batch.day, batch.index, batch.drives[:2])


@pytest.mark.parametrize("name", CAMPAIGNS)
def test_campaigns_give_the_same_bits(name: str) -> None:
    campaign = load_campaign(name, SHIPPED_CONFIGS)
    batch = campaign.batches(campaign.days()[0])[0]
    digests = (campaign.digest, batch.digest, checksum(simulate_batch(SIGNALS, short(batch))))
    assert digests == CAMPAIGNS[name]


@pytest.mark.parametrize("name", SCENARIOS)
def test_scenarios_give_the_same_bits(name: str) -> None:
    batch = load_scenario(name, SHIPPED_CONFIGS).batch()
    assert (batch.digest, checksum(simulate_batch(SIGNALS, batch))) == SCENARIOS[name]
