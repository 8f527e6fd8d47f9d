"""JavaScript that the pages of this package share: each page has it in itself, so that nothing is loaded."""

from pathlib import Path

FILM = Path(__file__).parent / "film.js"
"""Draws the films of :mod:`ftl_lightning.evaluation.pictures`; the first script of a page, as it says ``"use strict"``."""
