"""The catalog of the shipped configs, which most tests use."""

from fleet_slip.catalogue.catalog import load_catalog

CATALOG = load_catalog()
SIGNALS = CATALOG.signals
