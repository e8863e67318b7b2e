"""Learned rivals of the regression, fitted on a sample of rows of the same cohort.

Needs the optional dependency `fleet-slip[rivals]`, scikit-learn.
"""
