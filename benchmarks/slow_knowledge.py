"""What ten seconds and more tell of load and road: ordinary least squares with products of it.

    python -m benchmarks.slow_knowledge [--cars sedan|fleet] [--folds 12] [--drives 4]

Drives are drawn as blind ones are: roads of every class and drivers with lines of their own; load,
adhesion and lean are those of a kind of drive. With `sedan` all cars are the paper's, with its
sensors; with `fleet` they are those of `fleet_realistic`. Each car has three drives before, dry and
empty, that tell its own numbers. Roads and cars are left out together, fold by fold. To windows and
the gate `excess`, each row adds products of what is shown with five columns. Prints root mean
square errors in degrees by kind of drive, against the exact angle, of every fortieth row.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from benchmarks.slow_drives import EVERY, KINDS, ROADS, THIN, Part, simulated
from fleet_slip.arrays import FloatArray
from fleet_slip.catalogue.features import features

PRODUCTS = ("rear_curvature_mean_16", "rear_ay_mean_16", "ay_square_mean_16", "steering_mean_16",
            "course_sum_64")  # fmt: skip


class Rows:
    """The rows of all drives, by fold and kind, with sums of products of their columns."""

    def __init__(self, parts: Sequence[Part], names: Sequence[str]) -> None:
        """Take the rows of each drive, whose columns have names."""
        parts = sorted(parts, key=lambda part: (part.fold, part.kind))
        sizes = [len(part.known["y"]) for part in parts]
        self.known = {
            name: np.concatenate([part.known[name] for part in parts]) for name in parts[0].known
        }
        self.fold = np.repeat([part.fold for part in parts], sizes)
        self.kind = np.repeat([part.kind for part in parts], sizes)
        self.folds = int(self.fold.max()) + 1
        self.names, self.y = list(names), self.known["y"]
        self.columns = _scaled(self.known.pop("columns"))
        self.last = np.isin(np.arange(len(self.y)), np.cumsum(sizes) - 1)
        self.five = self.columns[:, [self.names.index(name) for name in PRODUCTS]]
        self.cells = [
            np.flatnonzero((self.fold == fold) & (self.kind == kind))
            for fold in range(self.folds)
            for kind in range(len(KINDS))
        ]

    def of(self, *gates: str) -> list[int]:
        """Return the places of the windows, and of the columns of some gates."""
        known = features()
        shut = {one for gate in features().gates for one in known.members(gate)}
        shut -= {one for gate in gates for one in known.members(gate)}
        return [place for place, name in enumerate(self.names) if name not in shut]

    def times(self, shown: FloatArray) -> FloatArray:
        """Return what is shown, by itself and times the five columns, shape (rows, products)."""
        products = shown[:, :, None] * np.column_stack([np.ones(len(shown)), self.five])[:, None]
        return np.asarray(products.reshape(len(shown), -1))

    def judge(
        self,
        name: str,
        places: list[int],
        more: FloatArray | Callable[[int], FloatArray] | None = None,
    ) -> None:
        """Fit without each fold, with more columns that may depend on it, and print the errors."""
        squares, counts = np.zeros(len(KINDS)), np.zeros(len(KINDS))
        seen = self.columns
        grams: list[FloatArray] = []
        for fold in range(self.folds):
            if not fold or callable(more):
                added = more(fold) if callable(more) else more
                beside = self.columns[:, :0] if added is None else _scaled(added)
                ends = np.degrees(self.y)[:, None]
                parts = (np.ones_like(ends), self.columns[:, places], beside, ends)
                seen = np.hstack([part.astype(np.float32) for part in parts])
                grams = [(seen[rows].T @ seen[rows]).astype(np.float64) for rows in self.cells]
            here = range(fold * len(KINDS), (fold + 1) * len(KINDS))
            total = np.sum([one for cell, one in enumerate(grams) if cell not in here], axis=0)
            fitted = np.append(_solved(total[:-1, :-1], total[:-1, -1]), -1.0)
            for kind, cell in enumerate(here):
                squares[kind] += np.sum((seen[self.cells[cell]] @ fitted) ** 2)
                counts[kind] += len(self.cells[cell])
        told = [f"{error:.3f}".lstrip("0") for error in np.sqrt(squares / counts)]
        together = f"{np.sqrt(squares.sum() / counts.sum()):.3f}".lstrip("0")
        print(f"| {name} | {seen.shape[1] - 2} | {' | '.join(told)} | {together} |", flush=True)

    def learned(self, products: bool) -> Callable[[int], FloatArray]:
        """Return place and adhesion, as least squares tells them from all slopes.

        Each fold is told by others, or what is added would look surer than it is elsewhere.
        """
        slopes = [self.known[name] for name in ("understeer", "damping", "kinematic", "peak")]
        slow = np.clip(_scaled(np.hstack(slopes)), -3, 3).astype(np.float64)
        i, j = np.triu_indices(slow.shape[1] if products else 0)
        terms = np.hstack([np.ones((len(slow), 1)), slow, slow[:, i] * slow[:, j]])
        of = [self.fold == fold for fold in range(self.folds)]
        inner = np.stack([terms[one].T @ terms[one] for one in of])
        wanted = np.stack([terms[one].T @ self.known["truth"][one] for one in of])

        def by_fold(fold: int) -> FloatArray:
            told = np.empty((len(terms), 3))
            for other in range(self.folds):
                rest = [one for one in range(self.folds) if one not in (fold, other)] or [other]
                told[of[other]] = terms[of[other]] @ _solved(
                    inner[rest].sum(axis=0), wanted[rest].sum(axis=0)
                )
            return self.times(np.column_stack([opened(told[:, 0]), told[:, 2]]))

        return by_fold

    def bank(self, rows_back: int, sharp: bool) -> Callable[[int], FloatArray]:
        """Return how well a model of each kind predicted yaw rate and ay, one row ahead.

        Sharp: weights of the likelihood of errors as of white noise. Otherwise what integers can
        do: the difference of two windows of squared errors over their sum.
        """
        after = np.minimum(np.arange(len(self.y)) + 1, len(self.y) - 1)
        places = [self.names.index(name) for name in ("yaw_rate_mean_16", "ay_mean_16")]
        next_steer = self.columns[after][:, [self.names.index("steering_mean_8")]]
        ones = np.ones((len(self.y), 1), np.float32)
        given = np.hstack([ones, self.columns[:, self.of()], next_steer])
        wanted = self.columns[after][:, places]
        at = np.arange(len(self.y))
        begin = np.maximum.accumulate(np.where(np.append(True, self.last[:-1]), at, 0))
        begin = np.maximum(begin, at - rows_back)

        def by_fold(fold: int) -> FloatArray:
            of = (self.fold != fold) & ~self.last
            errors = []
            for kind in (0, 2, 3, 4, 5):
                some = of & (self.kind == kind)
                weights = _solved(given[some].T @ given[some], given[some].T @ wanted[some])
                errors.append(wanted - given @ weights)
            usual = np.min([error[of].std(axis=0) for error in errors], axis=0)
            squares = [(np.clip(e / usual, -5, 5) ** 2).sum(axis=1) * ~self.last for e in errors]
            total = np.vstack([np.zeros(5), np.cumsum(np.stack(squares, axis=1), axis=0)])
            shown = total[at] - total[begin]  # up to the row before
            if not sharp:
                return self.times((shown[:, 1:] - shown[:, :1]) / (shown[:, 1:] + shown[:, :1] + 9))
            likely = np.exp((shown.min(axis=1, keepdims=True) - shown) / 7)
            return self.times((likely / likely.sum(axis=1, keepdims=True))[:, 1:])

        return by_fold


def _solved(products: FloatArray, of: FloatArray) -> FloatArray:
    damped = products + 1e-6 * products[0, 0] * np.eye(len(products))
    return np.asarray(np.linalg.solve(damped.astype(np.float64), of.astype(np.float64)))


def _scaled(x: FloatArray) -> FloatArray:
    spread = x.std(axis=0, dtype=np.float64)
    scaled = (x - x.mean(axis=0, dtype=np.float64)) / np.where(spread > 0, spread, 1)
    return np.asarray(scaled, dtype=np.float32)


def opened(by: FloatArray) -> FloatArray:
    """Return the hats of the second to the last of five knots, as gates have them."""
    knots = np.quantile(by, (0.05, 0.25, 0.5, 0.75, 0.95))
    return np.stack([np.interp(by, knots, hat) for hat in np.eye(5)[1:]], axis=1)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cars", choices=("sedan", "fleet"), default="sedan")
    parser.add_argument("--folds", type=int, default=12)
    parser.add_argument("--drives", type=int, default=4, help="of each kind and fold")
    given = parser.parse_args()
    print_table(Rows(*simulated(given.cars == "fleet", given.folds, given.drives)), given.cars)


def print_table(rows: Rows, of: str) -> None:
    """Print the errors of every row of the table."""
    print(f"{len(rows.y):,} rows of {rows.last.sum()} drives on {ROADS * rows.folds} roads\n")
    print(f"| | columns | {' | '.join(kind.name for kind in KINDS)} | all |")
    print("| --- |" + " --- |" * (len(KINDS) + 2))
    rows.judge("windows", rows.of())
    excess, known = rows.of("excess"), rows.known
    rows.judge("and `excess`", excess)
    rows.judge("all gates but `road`", rows.of("excess", "cornering"))
    rows.judge("all gates of the set `gated`", rows.of("excess", "road", "cornering"))
    if of == "fleet":
        rows.judge("`excess` and the car's own numbers", excess, rows.times(known["own"]))
    for name, more in candidates(rows):
        rows.judge(name, excess, more)


def candidates(rows: Rows) -> Iterator[tuple[str, FloatArray | Callable[[int], FloatArray]]]:
    """Yield what is added to the windows and the gate `excess`."""
    known, times = rows.known, rows.times
    yield "understeer beyond the sedan's", times(opened(known["usual"][:, 0]))
    understeer = opened(known["understeer"][:, 0])
    yield "understeer beyond the car's own", times(understeer)
    yield "yaw damping beyond its own", times(opened(known["damping"][:, 1]))
    yield "understeer and damping, both at once", times(_clipped(known["damping"]))
    yield "slopes of the kinematic change beyond its own", times(_clipped(known["kinematic"]))
    yield "peak of abs(ay) within 60 s", times(opened(known["peak"][:, 0]))
    both = known["understeer"] * known["peak"]
    yield (
        "understeer, peak and their product",
        times(np.hstack([understeer, known["peak"], _clipped(both)])),
    )
    yield "wheel slip on ax beyond its own", times(opened(known["slip"][:, 0]))
    for rows_back in (25, 400):
        seconds = rows_back * EVERY * THIN // 100
        yield f"bank of five, likelihood within {seconds} s", rows.bank(rows_back, True)
        yield f"bank of five, differences within {seconds} s", rows.bank(rows_back, False)
    yield "place and adhesion, told by least squares from all slopes", rows.learned(False)
    yield "the same, from their products, too", rows.learned(True)
    yield "told where the load sits (no car is)", times(known["truth"][:, :1])
    yield "and mass and adhesion", times(np.hstack([known["truth"], known["truth"][:, 2:] ** 2]))


def _clipped(shown: FloatArray) -> FloatArray:
    return np.clip(_scaled(shown), -3, 3)


if __name__ == "__main__":
    main()
