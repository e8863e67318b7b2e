"""Estimators on drives, beside their rivals, and the report."""
