"""A browser, and an evaluation with films."""

from tests.apps.play.conftest import chromium as chromium
from tests.evaluation.conftest import evaluated as evaluated
