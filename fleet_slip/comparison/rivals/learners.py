"""The learners: how each is fitted to a sample, and how much a car would have to carry of it."""

import numpy as np

from fleet_slip.arrays import FloatArray
from fleet_slip.comparison.rivals.anfis import fit_anfis
from fleet_slip.comparison.rivals.learner import (
    SEED,
    Fitted,
    Learner,
    Names,
    hold_back,
    scikit_learn,
)
from fleet_slip.comparison.rivals.networks import fit_general_regression, fit_perceptron


def fit_regression(inputs: FloatArray, label: FloatArray, _: Names) -> Fitted:
    """Fit by ordinary least squares, as equation (4) does, on the rows of the sample."""
    centre = inputs.mean(axis=0)
    weights = np.linalg.lstsq(inputs - centre, label - label.mean(), rcond=None)[0]
    intercept = float(label.mean() - centre @ weights)

    def predict(rows: FloatArray) -> FloatArray:
        estimate: FloatArray = rows @ weights + intercept
        return estimate

    return Fitted(predict, int(weights.nbytes) + 8)


MOST_TREES = 500


def fit_trees(inputs: FloatArray, label: FloatArray, trip: Names) -> Fitted:
    """Fit gradient-boosted trees with at most 31 leaves each.

    As many, up to 500, as estimate drives better which they are not fitted to.
    """
    trees = scikit_learn("ensemble").HistGradientBoostingRegressor(
        learning_rate=0.1, max_iter=MOST_TREES, early_stopping=True, n_iter_no_change=20,
        tol=0.0, random_state=SEED,
    )  # fmt: skip
    held = hold_back(trip)
    trees.fit(inputs[~held], label[~held], X_val=inputs[held], y_val=label[held])
    # scikit-learn shows the nodes of these trees nowhere else.
    nodes = sum(tree.nodes.nbytes for stage in trees._predictors for tree in stage)
    return Fitted(trees.predict, int(nodes))


REGRESSION = Learner("regression", "ordinary least squares", fit_regression)
PERCEPTRON = Learner("mlp", "multilayer perceptron, 2 layers of 64", fit_perceptron)
TREES = Learner("trees", "gradient-boosted trees", fit_trees)
ANFIS = Learner("anfis", "adaptive neuro-fuzzy inference system", fit_anfis)
GENERAL = Learner("grnn", "general regression network", fit_general_regression)

LEARNERS = (REGRESSION, PERCEPTRON, TREES, ANFIS, GENERAL)
"""All learners, on signals of one instant."""

OF_WINDOWS = (REGRESSION, PERCEPTRON, TREES, ANFIS)
"""The learners that also get the published model's columns: a mean of neighbours is lost there."""
