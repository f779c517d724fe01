"""Policies of a participant, as the tests of evaluation have them."""

from tests.app.evaluations import policies as policies
