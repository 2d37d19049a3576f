"""Scores against ground truth, and the report."""
