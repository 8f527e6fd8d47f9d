"""Evaluation: generated behaviour, closed-loop execution, reference lines, results files and pictures."""
