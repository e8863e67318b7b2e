"""How fast drives in traffic are simulated, in simulated seconds per second of CPU time.

    python -m benchmarks.traffic [--drives 26] [--plot ROOT MODEL FILE]

What highway-env decides, then car, sensors and table; or a picture of the scenario `traffic`.
"""

import argparse
import time
from collections.abc import Iterator
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.patches import Rectangle
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

import fleet_slip
from fleet_slip.evaluation.watch import DriveFrames, scenario_frames
from fleet_slip.pages.page import STYLE, colour
from fleet_slip.resources import SHIPPED_CONFIGS
from fleet_slip.simulation.campaign import Batch, load_campaign
from fleet_slip.simulation.simulate import simulate_batch
from tests.support.catalog import SIGNALS

SHOWN_S = (31.0, 66.0)
"""What is drawn: merging and the roundabout."""


def plot(root: str, model: str, file: str) -> None:
    """Draw our car among the others, and its true and estimated angle below."""
    version = fleet_slip.open(root).models.get(model)
    frames = scenario_frames("traffic", version).part(*SHOWN_S)
    mpl.rcParams.update({**STYLE, "svg.hashsalt": "fleet_slip"})
    figure, (above, below) = plt.subplots(2, figsize=(8.0, 4.4), height_ratios=(1.5, 1))
    now = int(np.argmax([cars.shape[1] * (abs(s) > 1) for cars, s in _turns(frames)]))
    reach = slice(max(0, now - 75), now + 75)
    above.plot(frames.x_m[reach], frames.y_m[reach], color=colour("grid"), linewidth=14)
    ours = frames.x_m[now], frames.y_m[now], frames.heading_rad[now]
    for x, y, heading, name in [
        *((*place, "muted") for place in frames.other_cars[now].T),
        (*ours, "model_4"),
    ]:
        turned = Affine2D().rotate(heading).translate(x, y) + above.transData
        car = Rectangle((-2.5, -1), 5, 2, color=colour(name), transform=turned, zorder=3)
        above.add_patch(car)
    above.set(xlim=(ours[0] - 70, ours[0] + 70), ylim=(ours[1] - 22, ours[1] + 22), aspect="equal")
    above.set_title(f"Our car (blue) in highway-env's traffic after {frames.time_s[now]:.0f} s")
    above.axis("off")
    below.plot(frames.time_s, frames.sideslip_deg, color=colour("truth"), label="true")
    below.plot(frames.time_s, frames.estimate_deg, color=colour("model_4"), label=model)
    below.axvline(frames.time_s[now], color=colour("unstable"))
    below.set(xlabel="time, s", title="side-slip angle, °")
    below.legend(frameon=False, ncols=2)
    figure.tight_layout()
    figure.savefig(file, metadata={"Date": None})


def _turns(frames: DriveFrames) -> Iterator[tuple[NDArray[Any], float]]:
    return zip(frames.other_cars, frames.sideslip_deg.tolist(), strict=True)


def main() -> None:
    """Print the rate of each stage over drives of the campaign `traffic`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drives", type=int, default=26)
    parser.add_argument("--plot", nargs=3, metavar=("ROOT", "MODEL", "FILE"))
    arguments = parser.parse_args()
    if arguments.plot:
        return plot(*arguments.plot)
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
