"""A clinic day for the tests of its entries and pages."""

from __future__ import annotations

from tests.clinic_day import clinic_day

__all__ = ["clinic_day"]
