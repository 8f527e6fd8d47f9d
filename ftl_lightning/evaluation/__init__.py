"""Evaluation: generated behaviour, closed-loop execution, references, results files and pictures."""
