"""Policies and evaluations with known estimates, as the tests of evaluation have them."""

from tests.app.evaluations import judge as judge
