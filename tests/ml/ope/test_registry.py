"""Records of methods: every one is built at every size, the usual order is stated once, keys are unique."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import pytest

from ml.ope import registry
from ml.ope.registry import Size, build, estimators, method_keys, methods, preference, quick_estimators, register, shown


def test_every_method_but_the_combination_is_built_under_its_key_at_every_size() -> None:
    for method in methods():
        for size in get_args(Size):
            if method.factory is None:
                with pytest.raises(ValueError, match="'aggregate' is no method that can be fitted; these can: dlsm, dlsm_paper, linear"):
                    build(method.key, 0, size)
            else:
                assert build(method.key, 3, size).method == method.key
    assert set(estimators()) == set(method_keys()) - {registry.AGGREGATE}
    assert set(quick_estimators()) == {"linear", "fqe", "wdr", "wis", "cwpdis"}


def test_a_demonstration_is_smaller_than_a_study_and_a_seed_arrives() -> None:
    full, demo = (build("dlmm", 7, size) for size in ("full", "demo"))
    assert demo.config.members < full.config.members  # type: ignore[attr-defined]
    assert demo.config.seed == full.config.seed == 7  # type: ignore[attr-defined]


def test_the_usual_order_is_that_of_the_records() -> None:
    assert preference() == ("linear", "dlsm", "fqe", "wdr", "cwpdis", "wis", "dual_dice", "pdis")


def test_the_form_of_the_paper_runs_where_it_is_named_and_nowhere_else() -> None:
    asked = [m for m in methods() if not m.combines]
    assert [(m.key, m.name, m.preference, m.by_default, m.held_out) for m in asked] == [("dlsm_paper", "DLSM (paper)", None, False, False)]


def test_marks_are_told_apart_and_keys_are_taken_once() -> None:
    assert len({(m.colour, m.symbol) for m in methods()}) == len(methods()) == len({m.name for m in methods()})
    assert methods()[-1].key == registry.AGGREGATE
    with pytest.raises(ValueError, match="two methods of evaluation have the key 'fqe'"):
        register(replace(shown("fqe"), name="Another"))
