"""Fixtures of stored evaluations."""

from tests.app.evaluations import evaluate as evaluate
from tests.app.evaluations import judge as judge
from tests.app.evaluations import policies as policies
