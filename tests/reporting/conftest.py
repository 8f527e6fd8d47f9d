"""A browser, and an evaluation with films."""

from tests.evaluation.conftest import evaluated as evaluated
from tests.play.conftest import chromium as chromium
