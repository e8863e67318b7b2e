"""The shipped catalog, for tests that need one outside a data root."""

from fleet_slip.catalogue.catalog import load_catalog

CATALOG = load_catalog()
SIGNALS = CATALOG.signals
