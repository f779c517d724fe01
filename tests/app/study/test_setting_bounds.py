"""Settings have clinical bounds, stated with their unit; whatever is set, or was stored before there were bounds, no page answers 500."""

from __future__ import annotations

from typing import Any

import pytest
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.platform.database import transaction
from app.study.settings_types import SETTING_BOUNDS, SettingsFields
from app.tables.participants import Participant, SettingsVersion
from app.tables.visits import CdbsAmplitude
from tests.app.conftest import Upload

HTML = {"Accept": "text/html", "Sec-Fetch-Site": "same-origin"}
TINY = 5e-324
ANYTHING = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False), st.sampled_from([0.0, TINY, -TINY, 1e-300, 1e308, -1e308, 0.1, 0.99999999999, 1.0])
)
PAGES = (
    "/", "/trial-time", "/participants/P1", "/participants/P1/settings", "/participants/P1/analyses", "/participants/P1/jobs",
    "/participants/P1/ranking", "/participants/P1/calibration", "/participants/P1/buffer-gate", "/participants/P1/proposals",
    "/participants/P1/policies", "/visits/{visit}", "/sessions/{session}", "/api/v1/participants/P1", "/api/v1/participants/P1/settings",
    "/api/v1/visits/{visit}", "/api/v1/sessions/{session}/trace",
)  # fmt: skip


def open_every_page(client: TestClient, session: int, visit: int = 1) -> None:
    """Read all pages that show what settings decide; the client raises what the service does not handle."""
    for path in PAGES:
        answer = client.get(path.format(session=session, visit=visit), headers=HTML)
        assert answer.status_code < 500, (path, answer.text[-500:])
        if not path.startswith("/api"):
            assert answer.status_code == 200, (path, answer.text[-500:])


@pytest.mark.parametrize("name", sorted(SETTING_BOUNDS))
def test_a_value_outside_its_bounds_is_refused_with_the_bounds_and_the_unit(client: TestClient, participant_code: str, name: str) -> None:
    bound = SETTING_BOUNDS[name]
    whole = name == "window"
    for value in (bound.low - 1, bound.high + 1):
        wrong = int(value) if whole else value
        by_program = client.put("/api/v1/participants/P1/settings", json={"settings": {name: wrong}})
        by_form = client.post("/participants/P1/settings", data={name: str(wrong)}, headers=HTML)
        for answer in (by_program, by_form):
            assert answer.status_code == 422, (name, value)
            assert f"must lie between {bound.low:g} and {bound.high:g} {bound.unit}".rstrip() in answer.text
    for value in (bound.low, bound.high):
        right = int(value) if whole else value
        answer = client.put("/api/v1/participants/P1/settings", json={"settings": {name: right}})
        assert answer.status_code == 200 or "must lie between" not in answer.text, answer.text


@pytest.mark.parametrize(("unit", "status"), [("uV", 422), ("dB", 200)])
def test_a_threshold_is_positive_but_in_units_that_may_be_negative(
    client: TestClient, participant_code: str, unit: str, status: int
) -> None:
    for xi_beta in (-1.0, 0.0):
        body = {"settings": {"xi_beta": xi_beta, "beta_unit": unit}}
        assert client.put("/api/v1/participants/P1/settings", json=body).status_code == status


@pytest.mark.parametrize("amplitude", [TINY, 0.0, 0.09, 25.6])
def test_a_visits_cdbs_amplitude_has_the_same_bounds(client: TestClient, participant_code: str, amplitude: float) -> None:
    stated = {"cdbs_amplitudes": [{"hemisphere": "left", "amplitude_ma": amplitude}]}
    answers = [
        client.post("/api/v1/participants/P1/visits", json={"number": 2} | stated),
        client.patch("/api/v1/visits/1", json={"reason": "x"} | stated),
        client.post("/participants/P1/visits", data={"number": "2", "cdbs_left": f"{amplitude:.400f}".rstrip("0")}, headers=HTML),
    ]
    for answer in answers:
        assert (answer.status_code, "must lie between 0.1 and 25.5 mA" in answer.text) == (422, True), answer.text[-600:]


def test_no_page_fails_whatever_is_set(client: TestClient, participant_code: str, upload: Upload) -> None:
    session = upload(steps=12)
    names = sorted(set(SETTING_BOUNDS) - {"window"})

    @settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck), database=None)
    @given(
        values=st.dictionaries(st.sampled_from(names), ANYTHING, min_size=1, max_size=5), window=st.integers(-1, 501), form=st.booleans()
    )
    def try_it(values: dict[str, float], window: int, form: bool) -> None:
        chosen: dict[str, Any] = {**values, "window": window}
        if form:
            answer = client.post("/participants/P1/settings", data={n: repr(v) for n, v in chosen.items()}, headers=HTML)
            assert answer.status_code in (200, 303, 422), answer.text[-500:]
        else:
            answer = client.put("/api/v1/participants/P1/settings", json={"settings": chosen})
            assert answer.status_code in (200, 422), answer.text
        open_every_page(client, session)

    try_it()


EARLIER = [
    {"cdbs_amplitude_ma": TINY},
    {"cdbs_amplitude_ma": 1e308, "xi_beta": -1e308},
    {"xi_beta": TINY, "c1": 1e308, "r_a": 1e308, "r_b": -1e308},
    {"gamma": 1 - 1e-16, "lower_bound": 0.0, "min_valid_fraction": TINY, "c2": TINY},
    {"beta_low_hz": TINY, "beta_high_hz": 1e308},
]


@pytest.mark.parametrize("earlier", EARLIER, ids=lambda e: ",".join(e))
def test_rows_of_before_there_were_bounds_are_shown_and_break_no_page(
    client: TestClient, participant_code: str, upload: Upload, db: Session, earlier: dict[str, float]
) -> None:
    session = upload(steps=12)
    with transaction("test") as own:
        participant = own.scalars(select(Participant)).one()
        present = participant.current_settings
        copied = {name: getattr(present, name) for name in SettingsFields.model_fields} | earlier
        own.add(SettingsVersion(participant_id=participant.id, version=present.version + 1, created_by="test", **copied))
        if "cdbs_amplitude_ma" in earlier:
            own.add(CdbsAmplitude(visit_id=1, hemisphere="left", program=0, amplitude_ma=earlier["cdbs_amplitude_ma"]))
    open_every_page(client, session)
    shown = client.get("/api/v1/participants/P1").json()["settings"]
    assert {name: shown[name] for name in earlier} == earlier
    mended = client.put("/api/v1/participants/P1/settings", json={"settings": {n: v for n, v in _defaults().items() if n in earlier}})
    assert mended.status_code == 200, mended.text
    open_every_page(client, session)


def _defaults() -> dict[str, Any]:
    return SettingsFields().model_dump() | {"xi_beta": 1.0, "cdbs_amplitude_ma": 3.0}
