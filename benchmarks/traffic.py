"""How fast drives in traffic are simulated, in simulated seconds per second of CPU time.

    python -m benchmarks.traffic [--drives 26]

What highway-env decides, then car, sensors and table.
"""

import argparse
import time

from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.campaign import Batch, load_campaign
from fleet_slip.simulation.simulate import simulate_batch
from tests.support.catalog import SIGNALS


def main() -> None:
    """Print the rate of each stage over drives of the campaign `traffic`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drives", type=int, default=26)
    arguments = parser.parse_args()
    campaign = load_campaign("traffic", SHIPPED_CONFIGS)
    specs = campaign.drives(campaign.first_day)[: arguments.drives]
    spent: dict[str, float] = {}
    start = time.process_time()
    for spec in specs:
        before = time.process_time()
        assert spec.in_traffic
        spent[spec.track.name] = spent.get(spec.track.name, 0.0) + time.process_time() - before
    decided = time.process_time()
    table = simulate_batch(SIGNALS, Batch(campaign.name, campaign.first_day, 0, specs))
    ended = time.process_time()
    driven_s = table.num_rows / 100
    for road, cpu_s in sorted(spent.items()):
        asked_s = sum(s.traffic.duration_s for s in specs if s.traffic and s.track.name == road)
        print(f"{road:14} {asked_s / cpu_s:6.0f} times real time")
    print(f"{'decisions':14} {driven_s / (decided - start):6.0f} times real time")
    print(f"{'car and table':14} {driven_s / (ended - decided):6.0f} times real time")
    print(f"{'together':14} {driven_s / (ended - start):6.0f} times real time")


if __name__ == "__main__":
    main()
