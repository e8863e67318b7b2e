"""An adaptive neuro-fuzzy inference system: rules whose conclusions are linear, blended smoothly.

Jang, "ANFIS: adaptive-network-based fuzzy inference system", IEEE Transactions on Systems, Man, and
Cybernetics 23 (1993); for side-slip Boada et al., "Sideslip angle estimator based on ANFIS for
vehicle handling and stability", Journal of Mechanical Science and Technology 29 (2015). Takagi and
Sugeno's first-order rules r with Gaussian memberships of the premises z:

    y = Σ w_r f_r / Σ w_r,    log w_r = −½ Σ_j ((z_j − c_rj) / s_rj)²,    f_r = p_r · x + q_r

The premises are the first principal components of the scaled inputs, which for a car are turning,
speed and braking; rules are scattered where rows are (k-means). The hybrid learning is Jang's:
least squares for the conclusions, then a step down the gradient for centres and widths.
"""

from dataclasses import dataclass

import numpy as np
from sklearn.cluster import KMeans

from benchmarks.rivals.learners import SEED, FittedLearner, Names, Scaling, hold_back
from fleet_slip.arrays import FloatArray

RULES = 9
PREMISES = 3
LEARNING_ROWS = 20_000
"""Rows of which centres and widths are learned; the conclusions then follow from all."""

LEARNING_COLUMNS = 32
"""Principal components that conclusions see meanwhile, at most; then they see every input."""

EPOCHS = 25
FIRST_STEP = 0.05
"""Length of a step of all centres and log widths together, in standard deviations."""

GROW, SHRINK = 1.1, 0.7
"""How the step changes when the error has become smaller or larger."""

BLOCK = 8192
"""Rows that are worked on at once."""

RIDGE = 1e-9
"""Ridge of the least squares, per row: bounds the conclusions of rules that no row activates."""


@dataclass(frozen=True)
class Premises:
    """Centres and logarithms of widths of the rules' memberships, shape (rules, premises)."""

    centre: FloatArray
    log_width: FloatArray

    def firing(self, z: FloatArray) -> FloatArray:
        """Return the normalised strength of each rule at rows of premises: (rows, rules)."""
        distance = (z[:, None, :] - self.centre) / np.exp(self.log_width)
        log_w = -0.5 * (distance**2).sum(axis=2)
        strength = np.exp(log_w - log_w.max(axis=1, keepdims=True))
        return np.asarray(strength / strength.sum(axis=1, keepdims=True))

    def gradient(
        self, z: FloatArray, x: FloatArray, conclusions: FloatArray, label: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of half the mean squared error by centres and log widths."""
        share = self.firing(z)
        outputs = x @ conclusions.T
        estimate = (share * outputs).sum(axis=1, keepdims=True)
        pull = (estimate - label[:, None]) * share * (outputs - estimate) / len(z)
        width = np.exp(self.log_width)
        distance = (z[:, None, :] - self.centre) / width
        by_centre = np.einsum("nr,nrj->rj", pull, distance) / width
        return by_centre, np.einsum("nr,nrj->rj", pull, distance**2)

    def step(self, slope: tuple[FloatArray, FloatArray], length: float) -> "Premises":
        """Return the premises a step of a length down the slope."""
        size = float(np.sqrt(sum((part**2).sum() for part in slope)))
        scale = length / max(size, np.finfo(float).tiny)
        return Premises(self.centre - scale * slope[0], self.log_width - scale * slope[1])


def conclude(share: FloatArray, x: FloatArray, label: FloatArray) -> FloatArray:
    """Return the conclusions of all rules by least squares, shape (rules, columns)."""
    rules, columns = share.shape[1], x.shape[1]
    gram, moments = np.zeros((rules * columns, rules * columns)), np.zeros(rules * columns)
    for first in range(0, len(x), BLOCK):
        part = slice(first, first + BLOCK)
        design = (share[part, :, None] * x[part, None, :]).reshape(-1, rules * columns)
        gram += design.T @ design
        moments += design.T @ label[part]
    gram[np.diag_indices_from(gram)] += RIDGE * len(x)
    return np.linalg.solve(gram, moments).reshape(rules, columns)


def infer(share: FloatArray, x: FloatArray, conclusions: FloatArray) -> FloatArray:
    """Return the rules' conclusions, blended by their strengths, shape (rows,)."""
    blended: FloatArray = (share * (x @ conclusions.T)).sum(axis=1)
    return blended


def scatter(z: FloatArray) -> Premises:
    """Return rules where the rows of premises are, as wide as their neighbours are far."""
    means = KMeans(min(RULES, len(z)), n_init=3, random_state=SEED)
    centre: FloatArray = means.fit(z).cluster_centers_.astype(np.float64)
    apart = np.sqrt(((centre[:, None] - centre[None]) ** 2).sum(axis=2))
    apart[np.diag_indices_from(apart)] = np.inf
    nearest = apart.min(axis=1, keepdims=True) if len(centre) > 1 else np.ones((1, 1))
    width = np.maximum(nearest, 0.1) * np.ones_like(centre)
    return Premises(centre, np.log(width))


def learn(
    start: Premises,
    rows: tuple[FloatArray, FloatArray, FloatArray],
    judge: tuple[FloatArray, FloatArray, FloatArray],
) -> Premises:
    """Return the learned premises that estimate `judge` best; rows are premises, inputs, label."""
    z, x, label = rows
    best, now, length = start, start, FIRST_STEP
    least, before = np.inf, np.inf
    for _ in range(EPOCHS):
        conclusions = conclude(now.firing(z), x, label)
        error = float(np.mean((infer(now.firing(judge[0]), judge[1], conclusions) - judge[2]) ** 2))
        if error < least:
            least, best = error, now
        length *= GROW if error < before else SHRINK
        before = error
        now = now.step(now.gradient(z, x, conclusions, label), length)
    return best


def fit_anfis(inputs: FloatArray, label: FloatArray, trip: Names) -> FittedLearner:
    """Fit rules to rows; centres and widths are those that estimate drives held back best."""
    scaling, label_scaling = Scaling.fit(inputs), Scaling.fit(label)
    scaled, targets = scaling(inputs), label_scaling(label)
    axes = np.linalg.svd(scaled[:: max(1, len(scaled) // LEARNING_ROWS)], full_matrices=False)[2].T
    leading = axes[:, :LEARNING_COLUMNS]
    axes = axes[:, :PREMISES]

    def premises(rows: FloatArray) -> FloatArray:
        return np.asarray(rows @ axes)

    def with_one(rows: FloatArray) -> FloatArray:
        return np.column_stack([rows, np.ones(len(rows))])

    held = hold_back(trip)
    thin = np.flatnonzero(~held)[:: max(1, int((~held).sum()) // LEARNING_ROWS)]
    parts = [
        (premises(scaled[part]), with_one(scaled[part] @ leading), targets[part])
        for part in (thin, np.flatnonzero(held))
    ]
    parameters = learn(scatter(parts[0][0]), parts[0], parts[1])
    conclusions = conclude(parameters.firing(premises(scaled)), with_one(scaled), targets)

    def predict(rows: FloatArray) -> FloatArray:
        x = scaling(rows)
        estimate = infer(parameters.firing(premises(x)), with_one(x), conclusions)
        return estimate * label_scaling.std + label_scaling.mean

    arrays = (parameters.centre, parameters.log_width, conclusions, axes)
    size = sum(array.nbytes for array in arrays) + scaling.size_bytes + label_scaling.size_bytes
    return FittedLearner(predict, int(size))
